"""A device as its agent's code sees it, over the mesh: call it and know how that ended, hear what it says."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import zenoh

from bridges.serial.device_id import PRESENT, DeviceId
from bridges.serial.dialect import Ending
from bridges.serial.edge import PATIENCE
from bridges.serial.errors import REASONS, CallFailed, CallInDoubt, CallNotDone
from mesh.network import Pump
from schemas import LiabilityTopicKey, payload_type
from schemas.errors import InvalidPayload
from schemas.payloads import Empty, decode_value, encode_value

if TYPE_CHECKING:
    from mesh.agent import Agent
    from mesh.work.job import Job

LOOK: Final = 0.25
"""Seconds between two looks for a device that is not present."""
GRACE: Final = 5.0
"""Seconds beyond a call's own time in which its edge agent has to say how it ended."""


class _Failure(msgspec.Struct, frozen=True):
    """An error reply of the edge agent."""

    reason: str
    detail: str


@dataclass(frozen=True)
class Answer:
    """How a call ended well, and what the device answered (None for nothing).

    `ending` says what is known: `DONE`, that the device has done it, once; `READ`, from a rosserial board, that it has
    read on after the message, which it skips silently if it was damaged on the line.
    """

    value: Any
    ending: Ending


class Device:
    """The device `name` of a running agent, on whatever machine its `aira edge` runs.

    A call waits at most `patience` seconds for the device to be there and to do it. `in_doubt` says what becomes of a
    call of which nobody knows whether it was done, since the device was restarted meanwhile: `fail`, or `again` for
    what does no harm when it is done twice.
    """

    def __init__(
        self,
        agent: Agent,
        name: str = "board",
        *,
        patience: float = PATIENCE,
        in_doubt: Literal["fail", "again"] = "fail",
    ) -> None:
        self._agent = agent
        self.name = name
        self._patience = patience
        self._in_doubt = in_doubt

    async def call(self, topic: str, message: object = Empty(), *, job: Job | None = None) -> Answer:
        """Have the device do something; returns when it is done. With a `job` both are in its recording.

        `message` is what `Job.publish` takes. Raises `CallNotDone` (it certainly was not), `CallRefused` (the device
        said no, or can't), `CallInDoubt`, and never takes longer than `patience` and a few seconds. Cancelling stops
        the waiting, not the device.
        """
        payload, kind = encode_value(message)
        key = self._key(topic, job)
        until = time.monotonic() + self._patience
        while True:
            await self._until_present(topic, until)
            try:
                return await self._call(topic, key, payload, kind.zenoh_encoding, max(0.0, until - time.monotonic()))
            except CallInDoubt:
                if self._in_doubt == "fail" or time.monotonic() >= until:
                    raise

    async def is_present(self) -> bool:
        """Whether the device is plugged in and answers."""
        return await asyncio.to_thread(self._look)

    def listen(self, topic: str) -> Pump[Any]:
        """What the device says on a topic outside any job: `async with device.listen("/x") as said`, then iterate.

        Messages are decoded; those that are not of their type are left out.
        """
        return Pump(self._session, self._device_id.key(topic), _decoded)

    @property
    def _device_id(self) -> DeviceId:
        return DeviceId(agent=self._agent.address, name=self.name)

    @property
    def _session(self) -> zenoh.Session:
        return self._agent.parts.network.session

    def _key(self, topic: str, job: Job | None) -> str:
        if job is None:
            return self._device_id.key(topic)
        return str(LiabilityTopicKey(self._agent.address, job.liability.address, topic))

    def _look(self) -> bool:
        replies = self._session.liveliness().get(self._device_id.key(PRESENT), timeout=GRACE)
        return any(reply.ok is not None for reply in replies)

    async def _until_present(self, topic: str, until: float) -> None:
        while not await self.is_present():
            if time.monotonic() >= until:
                raise CallNotDone(topic, "absent", f"the device {self.name} was not there for {self._patience:g} s")
            await asyncio.sleep(LOOK)

    async def _call(self, topic: str, key: str, payload: bytes, encoding: str, seconds: float) -> Answer:
        asking = zenoh.CancellationToken()
        ask = partial(self._session.get, payload=payload, encoding=encoding, timeout=seconds + GRACE)
        selector = f"{key}?timeout={seconds:.3f};device={self.name}"
        try:
            reply = await asyncio.to_thread(lambda: next(iter(ask(selector, cancellation_token=asking)), None))
        finally:
            asking.cancel()  # type: ignore[no-untyped-call]
        if reply is None:
            raise CallInDoubt(topic, "doubt", "the device's edge agent ended before it said how it went")
        if reply.ok is None:
            raise _failed(topic, b"" if reply.err is None else reply.err.payload.to_bytes())
        told = reply.ok.attachment
        ending = Ending.READ if told is not None and told.to_string() == Ending.READ.value else Ending.DONE
        value = decode_value(reply.ok.payload.to_bytes(), payload_type(str(reply.ok.encoding)))
        return Answer(value if value != b"" else None, ending)


def _decoded(sample: zenoh.Sample) -> Any:
    try:
        return decode_value(sample.payload.to_bytes(), payload_type(str(sample.encoding)))
    except InvalidPayload:
        return None


def _failed(topic: str, payload: bytes) -> CallFailed:
    try:
        failure = msgspec.json.decode(payload, type=_Failure)
        return REASONS[failure.reason](topic, failure.reason, failure.detail)
    except (msgspec.DecodeError, UnicodeDecodeError, KeyError):
        return CallInDoubt(topic, "doubt", "no answer came in time")
