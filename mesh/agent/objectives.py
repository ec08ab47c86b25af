"""The objectives of jobs and of demands: fetched if they are not in the store, and checked.

A job is paid for, so its objective is fetched in any case. A demand is only a stranger's word: fetching for demands is
limited for each maker and in total, and a CID that nobody had is remembered for a while.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final, Literal, NamedTuple
from weakref import WeakValueDictionary

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import Rate, RateLimiter
from mesh.content import ContentUnavailable
from mesh.errors import AiraError, ContentError, InputError
from mesh.recording import Limits, json_messages, preflight
from mesh.role.models import PATIENCE, Absences
from mesh.settings import LONGEST
from schemas.allowed import MOST_VALUES
from schemas.decoding import InvalidData
from schemas.model import Effort

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.handlers import TopicHandlers
    from mesh.content import Exchange, Store
    from mesh.recording import Objective
    from mesh.settings import ContentSettings
    from schemas.allowed import AllowedTopics
    from schemas.model import ModelDescription


FETCH_RATE: Final = Rate(per_second=1.0, burst=32)
"""Fetches for the demands of one maker."""
FREE_FETCH_RATE: Final = Rate(per_second=4.0, burst=64)
"""Fetches for all demands that pay nothing."""
SAME_FETCH: Final = 8
"""Demands that may wait for the same objective at once."""


class ObjectiveUnfit(InputError, code="objective-unfit"):
    """An objective can't be played here. `reason` is the word for programs that the check gave."""

    def __init__(self, cid: str, reason: str, detail: str, *, hint: str = "") -> None:
        super().__init__(f"objective {cid} can't be played ({reason}): {detail}", hint=hint)
        self.cid = cid
        self.reason = reason
        self.detail = detail


class ObjectiveNotFetched(ContentError, code="objective-not-fetched"):
    """An objective is not fetched for a demand now. `reason` is `missing` (nobody had it a moment ago), `shared`
    (enough others wait for it) or `rate` (there were too many fetches)."""

    def __init__(self, cid: str, reason: Literal["missing", "shared", "rate"]) -> None:
        super().__init__(
            f"objective {cid} is not fetched now ({reason})", hint="it is tried again with the demand's next copy"
        )
        self.cid = cid
        self.reason = reason


class Buyer(NamedTuple):
    """For whom an objective is fetched: the maker of a demand (address), and whether the demand pays."""

    maker: str
    pays: bool


class Objectives:
    """The objectives of jobs and of demands. They must fit the `handlers`, and the description of the `model`; and what
    the owner of a robot has `allowed`.
    """

    def __init__(
        self,
        store: Store,
        exchange: Exchange,
        settings: ContentSettings,
        handlers: TopicHandlers | None = None,
        model: ModelDescription | None = None,
        allowed: AllowedTopics | None = None,
    ) -> None:
        self._store = store
        self._exchange = exchange
        self._settings = settings
        self._handlers = handlers
        self._model = model
        self._allowed = allowed
        self._budget = FetchBudget()
        self._fetching = asyncio.Semaphore(32)  # one that nobody has must not delay the others
        self._checking = asyncio.Semaphore(1)  # a check uses one core, and up to 256 MiB of memory for a malicious file

    async def examine(self, cid: str, *, patience: float = LONGEST, buyer: Buyer | None = None) -> Objective:
        """The objective with that CID, from the store or fetched from the mesh, after it was checked.

        Fetching fails after `patience`, or the setting `fetch_timeout`, seconds without a new block. For a `buyer` it
        is limited: raises `ObjectiveNotFetched`. Raises `ObjectiveUnfit` and branches of `ContentError`.
        """
        path = await asyncio.to_thread(self._store.checked, cid)
        if path is None:
            async with self._fetching if buyer is None else self._budget.spend(cid, buyer):
                path = await self._fetch(cid, patience)
        objective = await self._check(cid, path, self._handlers, self._model)
        if self._allowed is not None:
            await asyncio.to_thread(_require_allowed, cid, objective, self._allowed)
        return objective

    async def refusal(self, cid: str, buyer: Buyer) -> AiraError | None:
        """Why the owner of this robot does not let a buyer order an objective; None if it may, or if no rules say so.

        It is the error of `examine`, which may also say that the objective is not available.
        """
        if self._allowed is None:
            return None
        try:
            await self.examine(cid, patience=10.0, buyer=buyer)
        except AiraError as error:
            return error
        return None

    async def require_playable(self, path: Path) -> None:
        """Raise `ObjectiveUnfit` for a file that no robot can play."""
        await self._check(str(path), path, None, None)

    async def require_fit(self, cid: str, model: ModelDescription) -> None:
        """Raise `ObjectiveUnfit` if an objective does not fit the model that a demand orders.

        One that is neither in the store nor served by others now is not checked.
        """
        path = await asyncio.to_thread(self._store.checked, cid)
        try:
            if path is None:
                path = await self._fetch(cid, PATIENCE)
        except ContentError:
            return
        await self._check(cid, path, None, model)

    async def _fetch(self, cid: str, patience: float) -> Path:
        limit, timeout = self._settings.objective_size_limit, min(patience, self._settings.fetch_timeout)
        return await self._exchange.fetch(cid, size_limit=limit, timeout=timeout, sync=False)

    async def _check(
        self, cid: str, path: Path, handlers: TopicHandlers | None, model: ModelDescription | None
    ) -> Objective:
        settings = self._settings
        limits = Limits.of(settings)
        topics, obstacle = (None, None) if handlers is None else (handlers.topics, handlers.obstacle)
        async with self._checking:
            outcome = await asyncio.to_thread(preflight, path, limits, topics=topics, obstacle=obstacle, model=model)
        if outcome.objective is None or not outcome.ok:
            raise ObjectiveUnfit(cid, outcome.reason, outcome.detail)
        return outcome.objective


def _require_allowed(cid: str, objective: Objective, allowed: AllowedTopics) -> None:
    """Raise `ObjectiveUnfit` unless all messages of an objective are allowed. Blocks on the disk."""
    effort = Effort(MOST_VALUES)
    try:
        for topic, value in json_messages(objective):
            if (fault := allowed.fault(topic, value, effort)) is not None:
                raise ObjectiveUnfit(cid, fault.code, fault.why)
    except InvalidData as error:
        raise ObjectiveUnfit(cid, "field-not-allowed", str(error)) from None
    except InputError as error:
        if isinstance(error, ObjectiveUnfit):
            raise
        raise ObjectiveUnfit(cid, "value-not-allowed", str(error)) from None


class FetchBudget:
    """What may be fetched for demands: `async with budget.spend(cid, buyer)` around a fetch."""

    def __init__(self) -> None:
        self._rate = RateLimiter(per_sender=FETCH_RATE)
        self._free = RateLimiter(per_sender=FETCH_RATE, total=FREE_FETCH_RATE)
        self._waiting: Counter[str] = Counter()
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._missing = Absences(4096, SYSTEM_CLOCK)

    @asynccontextmanager
    async def spend(self, cid: str, buyer: Buyer) -> AsyncIterator[None]:
        """Count a fetch, and remember the CID if it is not available; one fetch of a CID at a time.

        Raises `ObjectiveNotFetched`.
        """
        if self._waiting[cid] >= SAME_FETCH:
            raise ObjectiveNotFetched(cid, "shared")
        self._waiting[cid] += 1
        try:
            async with self._locks.setdefault(cid, asyncio.Lock()):
                self._check(cid, buyer)
                yield
                self._missing.discard(cid)
        except ContentUnavailable:
            self._missing.add(cid)
            raise
        finally:
            self._waiting[cid] -= 1
            if not self._waiting[cid]:
                del self._waiting[cid]

    def _check(self, cid: str, buyer: Buyer) -> None:
        if cid in self._missing:
            raise ObjectiveNotFetched(cid, "missing")
        limiter = self._rate if buyer.pays else self._free
        if not limiter.allow(buyer.maker):
            raise ObjectiveNotFetched(cid, "rate")
