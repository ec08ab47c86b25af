"""What a validator answers on its market: how it judges, and how it judged."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from mesh.background import call_in_loop
from mesh.flood import Rate, RateLimiter
from schemas import ReportKey, parse_address
from schemas.errors import InvalidAddress
from schemas.keys import ValidatorKey
from schemas.selectors import LIABILITY, market_selector
from schemas.verdicts import ValidatorAnnouncement

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.validator.components import ValidatorComponents

ANSWERS: Final = Rate(per_second=100.0, burst=1000)
"""Answers to queries. Zenoh does not say who asks, so that all share this."""
REFRESH: Final = 600.0
"""Seconds after which an announcement is signed again: parties ignore old ones."""
PENDING: Final = 64
"""Queries for reports that may be pending; further ones are dropped."""


class Announcements:
    """Answers queries of `ValidatorKey` with a signed announcement for each of the addresses that it judges for.

    An announcement is signed again when it is older than `refresh` seconds. `clock` is the time of day in seconds.
    """

    refresh: float = REFRESH
    """Seconds."""

    def __init__(self, parts: ValidatorComponents, *, clock: Callable[[], float] = time.time) -> None:
        self._parts = parts
        self._clock = clock
        self._rate = RateLimiter(per_sender=ANSWERS)
        self._signed: dict[str, ValidatorAnnouncement] = {}
        """By validator."""
        self._queryables: list[Any] = []

    async def __aenter__(self) -> Self:
        session, lighthouse = self._parts.network.session, self._parts.channel.lighthouse
        for validator in self._parts.bench.validators:
            key = str(ValidatorKey(lighthouse, validator))
            answer = partial(self._answer, key, validator)
            self._queryables.append(session.declare_queryable(key, answer, complete=True))
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if not self._parts.network.session.is_closed():
            for queryable in self._queryables:
                queryable.undeclare()

    def announcement(self, validator: str) -> ValidatorAnnouncement:
        """The signed announcement for one of the addresses."""
        now, found = int(self._clock()), self._signed.get(validator)
        if found is None or not 0 <= now - found.made_at < self.refresh:
            found = self._signed[validator] = self._sign(validator, now)
        return found

    def _sign(self, validator: str, now: int) -> ValidatorAnnouncement:
        bench, terms, signer = self._parts.bench, self._parts.terms, self._parts.signer
        is_contract = validator == bench.contract
        return ValidatorAnnouncement(
            validator=validator,
            juror=signer.address,
            title=terms.title,
            policies=tuple(policy.note for policy in terms.policies),
            fee=terms.fee,
            quorum=bench.quorum if is_contract else 1,
            jurors=bench.jurors if is_contract else 1,
            made_at=now,
        ).signed_by(signer)

    def _answer(self, key: str, validator: str, query: zenoh.Query) -> None:
        """Answer on Zenoh's thread, as nothing has to be read."""
        with query:
            if self._rate.allow(""):
                query.reply(key, self.announcement(validator).encode(), encoding="application/json")
            else:
                self._parts.drops.count("recall")


class ReportService:
    """Answers queries of `ReportKey` for a liability (`?liability=ADDRESS`) with the report in the ledger."""

    def __init__(self, parts: ValidatorComponents) -> None:
        self._parts = parts
        self._rate = RateLimiter(per_sender=ANSWERS)
        self._answers: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        loop, session = asyncio.get_running_loop(), self._parts.network.session
        selector = market_selector(self._parts.channel.lighthouse, "report", "*")
        self._queryable: Any = session.declare_queryable(
            selector, lambda query: call_in_loop(loop, self._received, query), complete=True
        )
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if not self._parts.network.session.is_closed():
            self._queryable.undeclare()
        for answer in self._answers:
            answer.cancel()

    def _received(self, query: zenoh.Query) -> None:
        if len(self._answers) >= PENDING or not self._rate.allow(""):
            self._parts.drops.count("recall")
            query.drop()  # type: ignore[no-untyped-call]
            return
        answer = asyncio.get_running_loop().create_task(self._answer(query), name="report")
        self._answers.add(answer)
        answer.add_done_callback(self._answers.discard)

    async def _answer(self, query: zenoh.Query) -> None:
        with query, suppress(InvalidAddress):  # leaving it ends the answer
            stored = await self._parts.ledger.verdict(parse_address(query.parameters.get(LIABILITY) or ""))
            if stored is None or not stored.report:
                return
            for party in {stored.liability.promisee, stored.liability.promisor}:
                key = str(ReportKey(self._parts.channel.lighthouse, party))
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, stored.report, encoding="application/json")
