"""The profile of a robot: what its settings and its model say of it, and what it is doing now.

It answers queries of `ProfileKey`, and is put there when it changes. A profile is signed anew for each, so that its
time says how old it is.
"""

from __future__ import annotations

import asyncio
import heapq
import json
import logging
import math
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from mesh.agent.ledger import Phase
from mesh.agent.orders import ROBOT_STOPPED
from mesh.base.database import LedgerUnusable
from mesh.base.flood import Rate
from mesh.errors import ChainError, ConfigurationError
from mesh.network.services import answering
from mesh.role.handover import handovers_to
from schemas import ProfileKey
from schemas.cid import is_cid
from schemas.payloads import plain_value
from schemas.profiles import (
    PROFILE_LIMITS,
    Profile,
    ProfileState,
    text_fault,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AbstractAsyncContextManager

    import zenoh

    from mesh.agent._owner_rules import OwnerRules
    from mesh.agent.components import AgentComponents
    from mesh.agent.jobs import Executor
    from mesh.settings import ProfileSettings
    from schemas.model import ModelDescription
    from schemas.payloads import PayloadType
    from schemas.profiles import Handover

log = logging.getLogger(__name__)

ASKED: Final = Rate(per_second=20.0, burst=100)
"""Queries for the profile that are answered."""
INTERVAL: Final = 1.0
"""Seconds between two profiles that are put, at least."""


class OwnProfile:
    """The profile of one robot. Call `prepare` once, then `serve` and `run`, and `changed` at any time."""

    def __init__(
        self,
        parts: AgentComponents,
        executor: Executor,
        rules: OwnerRules,
        description: ModelDescription | None,
        *,
        model: str,
    ) -> None:
        self._parts = parts
        self._executor = executor
        self._rules = rules
        self._model = model
        self._picture = ""
        self._handovers: tuple[Handover, ...] = ()
        self._seconds = float((None if description is None else description.seconds) or 0)
        self._changed = asyncio.Event()
        self._readings: dict[str, tuple[bytes, PayloadType]] = {}

    async def prepare(self) -> None:
        """Check the settings, put the picture into the store, and find the model's CID.

        Raises `ConfigurationError` (`profile-invalid`, `picture-unusable`).
        """
        settings = self._parts.settings
        self._handovers = handovers_to(settings.state_directory, self._parts.signer.address)
        for field in ("name", "about", "place"):
            if why := text_fault(field, getattr(settings, field)):
                raise ConfigurationError(f"the setting {field} can't be used: {why}", code="profile-invalid")
        if settings.picture:
            self._picture = await asyncio.to_thread(self._keep_picture, settings)
        if self._model and not is_cid(self._model):
            with suppress(ChainError):  # a name that can't be resolved now
                self._model = await self._parts.chain.names.model(self._model)
            self._model = self._model if is_cid(self._model) else ""

    def _keep_picture(self, settings: ProfileSettings) -> str:
        """The CID of the picture, which the store has if a file is given. Blocks on the disk."""
        path = Path(settings.picture).expanduser()
        if is_cid(settings.picture) and not path.exists():
            return settings.picture
        try:
            with path.open("rb") as file:
                data = file.read(PROFILE_LIMITS.picture + 1)
        except OSError as error:
            raise _unusable(f"can't read the picture {settings.picture}: {error.strerror}") from None
        if len(data) > PROFILE_LIMITS.picture:
            raise _unusable(f"the picture {settings.picture} has more than {PROFILE_LIMITS.picture:,} bytes")
        if not data.startswith((b"\x89PNG\r\n", b"\xff\xd8\xff")) and (data[:4], data[8:12]) != (b"RIFF", b"WEBP"):
            raise _unusable(f"{settings.picture} is no picture that others can show")
        self._parts.store.release("picture")  # that of an earlier run
        return self._parts.store.put_bytes(data, pin="picture")

    def read(self, topic: str, payload: bytes, kind: PayloadType) -> None:
        """The robot has published a reading. The profile has those of the first `PROFILE_LIMITS.readings` topics."""
        is_shown = topic in self._readings or len(self._readings) < PROFILE_LIMITS.readings
        if is_shown and len(topic) <= PROFILE_LIMITS.reading:
            self._readings[topic] = payload, kind

    def changed(self) -> None:
        """Something that the profile says may have changed."""
        self._changed.set()

    async def queue(self) -> tuple[int, int]:
        """How many jobs wait, and after how many seconds a new one would begin, estimated.

        The estimate is by the `seconds` of the model's description; 0 without one.
        """
        return self._queue_of(await self._parts.ledger.jobs_by_phase())

    def _queue_of(self, jobs: Mapping[str, int]) -> tuple[int, int]:
        runs = self._executor.runs.values()
        waiting, running = sum(jobs.get(phase, 0) for phase in (Phase.INCOMING, Phase.READY)), jobs.get("running", 0)
        played = [one.position / one.total for run in runs if (one := run.playback) is not None and one.total]
        # After which part of a job each of the `parallel` places is free.
        free = (
            [0.0] * (self._executor.parallel - running)
            + [1 - part for part in played]
            + [1.0] * (running - len(played))
        )
        heapq.heapify(free)
        for _ in range(min(waiting, PROFILE_LIMITS.waiting)):
            heapq.heapreplace(free, free[0] + 1)
        return waiting, math.ceil(self._seconds * free[0])

    async def present(self) -> Profile:
        """The signed profile of this moment."""
        return self._signed(*await self._doing())

    def _signed(self, price: str, state: ProfileState, queue: int, wait: int) -> Profile:
        settings, signer = self._parts.settings, self._parts.signer
        profile = Profile(
            agent=signer.address,
            model=self._model,
            name=settings.name,
            about=settings.about,
            picture=self._picture,
            place=settings.place,
            price=price,
            state=state,
            queue=queue,
            wait=wait,
            readings={topic: _text(*reading) for topic, reading in [*self._readings.items()]},
            handovers=self._handovers,
            time=int(time.time()),
        )
        return profile.signed_by(signer)

    async def _doing(self) -> tuple[str, ProfileState, int, int]:
        """What changes of the profile: `price`, `state`, `queue` and `wait`."""
        jobs = await self._parts.ledger.jobs_by_phase()
        waiting, seconds = self._queue_of(jobs)
        state: ProfileState = "working" if jobs.get("running") else "idle"
        if (closed := self._rules.closed()) is not None:
            state = "stopped" if closed.reason == ROBOT_STOPPED else "closed"
        return self._rules.price, state, min(waiting, PROFILE_LIMITS.waiting), min(seconds, PROFILE_LIMITS.waiting)

    def serve(self) -> AbstractAsyncContextManager[None]:
        """Meanwhile answer queries for the profile."""
        key = str(ProfileKey(self._parts.signer.address))

        async def answer(query: zenoh.Query) -> None:
            query.reply(key, (await self.present()).encode(), encoding="application/json")

        return answering(self._parts.network.session, key, answer, ASKED, self._parts.drops)

    async def run(self) -> None:
        """Put the profile when it has changed, at most once in `INTERVAL` seconds, until cancelled."""
        key = str(ProfileKey(self._parts.signer.address))
        said: tuple[str, ProfileState, int, int] | None = None
        while True:
            self._changed.clear()
            try:
                doing = await self._doing()
            except LedgerUnusable as error:
                log.debug("the profile is not known now: %s", error)
            else:
                if doing != said:
                    said = doing
                    self._parts.channel.put(key, self._signed(*doing).encode())
            await asyncio.sleep(INTERVAL)
            with suppress(TimeoutError):
                async with asyncio.timeout(2.0):  # then it looks by itself whether the profile has changed
                    await self._changed.wait()


def _text(payload: bytes, kind: PayloadType) -> str:
    """A reading as a line of text."""
    if len(payload) > 4096:
        return f"{len(payload):,} bytes"
    value = plain_value(payload, kind)
    if isinstance(value, bytes):
        return f"{len(value):,} bytes"
    text = value if isinstance(value, str) else json.dumps(msgspec.to_builtins(value), ensure_ascii=False)
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in text[: PROFILE_LIMITS.reading])


def _unusable(why: str) -> ConfigurationError:
    return ConfigurationError(why, hint="name a PNG, JPEG or WebP file", code="picture-unusable")
