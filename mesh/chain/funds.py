"""What accounts have of tokens and let the factory take: asked of the chain in batches, remembered for a short time.

Anybody can sign orders with fresh keys, so hundreds of accounts are asked for in one request to the node. A token is
code of a stranger: each question has `TOKEN_GAS`, and one that fails says nothing about the others.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.chain.errors import RequestRefused, Reverted
from mesh.chain.multicall import call_all
from mesh.clock import SYSTEM_CLOCK
from mesh.flood import BoundedDict

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from mesh.chain.contracts import Contracts
    from mesh.clock import Clock

log = logging.getLogger(__name__)

BATCH: Final = 256
"""Accounts in one request: the answers are 18 KB, of 24 that a node returns (EIP-170)."""
AT_ONCE: Final = 4
"""Requests at a time."""
TOKEN_GAS: Final = 100_000
"""Gas for each question to a token."""
KEPT_POLLS: Final = 3
"""Intervals between polls of the chain for which an answer is used."""
SHORT_POLLS: Final = 0.25
"""The same for an answer that there is too little: the maker may have paid in and sent its order at once."""
KEPT: Final = 8192
"""Answers that are remembered."""

_BALANCE, _ALLOWANCE = (bytes.fromhex(selector) + bytes(12) for selector in ("70a08231", "dd62ed3e"))
_WORD: Final = 32


class Holding(NamedTuple):
    """A token and its holder, both addresses."""

    token: str
    account: str


class Funding(NamedTuple):
    """What an account has of a token, and what the factory may take of it, in the token's smallest unit."""

    balance: int
    allowance: int


NO_TOKEN: Final = Funding(-1, -1)
"""What anybody has of a contract that does not say what somebody has, as a token does: it can't be paid with."""


class _KnownFunding(NamedTuple):
    asked_at: float
    block: bytes | None
    """The latest block that was known then."""
    funding: Funding | None


class Funds:
    """What accounts have of tokens, and let the factory take. `chain.funds`. Used in one event loop."""

    def __init__(self, contracts: Contracts, *, clock: Clock = SYSTEM_CLOCK, kept: int = KEPT) -> None:
        self._contracts = contracts
        self._clock = clock
        self._known: BoundedDict[Holding, _KnownFunding] = BoundedDict(kept)
        self._places = asyncio.Semaphore(AT_ONCE)
        self.requests = 0
        """Requests to the node so far."""

    async def of(
        self, holdings: Iterable[Holding], *, within: float = KEPT_POLLS, fresh: bool = False
    ) -> Mapping[Holding, Funding | None]:
        """What is known of holdings, read `within` that many poll intervals, in the latest block, or now.

        `NO_TOKEN` for what is no token, None if the node refuses to answer. Raises `NodeUnreachable`.
        """
        found: dict[Holding, Funding | None] = {}
        asked: list[Holding] = []
        now, block = self._clock.monotonic(), self._latest()
        for holding in dict.fromkeys(holdings):
            known = self._known.get(holding)
            if known is not None and not fresh and self._is_current(known, now, block, within):
                found[holding] = known.funding
            else:
                asked.append(holding)
        parts = [asked[start : start + BATCH] for start in range(0, len(asked), BATCH)]
        for answers in await asyncio.gather(*map(self._ask, parts)):
            for holding, funding in answers:
                self._known[holding] = _KnownFunding(now, block, funding)
                found[holding] = funding
        return found

    def _latest(self) -> bytes | None:
        latest = self._contracts.node.heads.latest
        return None if latest is None else latest.hash

    def _is_current(self, known: _KnownFunding, now: float, block: bytes | None, within: float) -> bool:
        """Nothing changes between two blocks. But who is in a hurry may know of a block before we do."""
        node = self._contracts.node
        if within >= KEPT_POLLS and block is not None and block == known.block and node.heads.are_timely:
            return True
        return now < known.asked_at + within * node.timing.poll_interval

    async def _ask(self, batch: Sequence[Holding]) -> Iterable[tuple[Holding, Funding | None]]:
        async with self._places:
            return zip(batch, await self._read(batch), strict=True)

    async def _read(self, batch: Sequence[Holding]) -> list[Funding | None]:
        """What the node says; of half the batch at a time if it refuses, as when some tokens use up their gas."""
        spender = bytes.fromhex(self._contracts.factory[2:])
        calls = []
        for token, holder in batch:
            account = bytes.fromhex(holder[2:])
            calls += [(token, _BALANCE + account), (token, _ALLOWANCE + account + bytes(12) + spender)]
        self.requests += 1
        try:
            answers = await call_all(self._contracts.node, calls, gas=TOKEN_GAS, most=_WORD)
        except (Reverted, RequestRefused) as error:
            if len(batch) == 1:
                log.debug("the funds of %s can't be read: %s", batch[0], error)
                return [None]
            half = len(batch) // 2
            return [*await self._read(batch[:half]), *await self._read(batch[half:])]
        return [_funding(*answers[at : at + 2]) for at in range(0, len(answers), 2)]


def _funding(balance: bytes | None, allowance: bytes | None) -> Funding:
    if balance is None or allowance is None or len(balance) != _WORD or len(allowance) != _WORD:
        return NO_TOKEN
    return Funding(int.from_bytes(balance), int.from_bytes(allowance))
