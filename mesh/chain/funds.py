"""What accounts have of tokens and let the factory take: asked of the chain in batches, remembered for a short time.

Anybody can sign orders with fresh keys, so many accounts are asked for. One request to the node answers for `BATCH`
accounts: a call without a contract, whose code asks the tokens. A token is code of a stranger: each question has
`TOKEN_GAS`, and one that fails says nothing about the others.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.chain.answers import InvalidAnswer
from mesh.chain.errors import RequestRefused, Reverted
from mesh.clock import SYSTEM_CLOCK

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain.contracts import Contracts
    from mesh.clock import Clock

log = logging.getLogger(__name__)

BATCH: Final = 64
"""Accounts in one request."""
TOKEN_GAS: Final = 100_000
"""Gas for each question to a token."""
KEPT_POLLS: Final = 3
"""Intervals between polls of the chain for which an answer is used."""
SHORT_POLLS: Final = 0.25
"""The same for an answer that there is too little: the maker may have paid in and sent its order at once."""
KEPT: Final = 8192
"""Answers that are remembered."""

_WORD: Final = 32
_ANSWERS: Final = 256
"""Where in the code's memory the answers begin; the question is in front of them."""


class Holding(NamedTuple):
    """A token and its holder, both addresses."""

    token: str
    account: str


class Funding(NamedTuple):
    """What an account has of a token, and what the factory may take of it, in the token's smallest unit."""

    balance: int
    allowance: int


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
        self._kept = kept
        self._known: OrderedDict[Holding, _KnownFunding] = OrderedDict()
        self._asked: dict[Holding, asyncio.Future[Funding | None]] = {}
        self._asking: asyncio.Task[None] | None = None
        self.requests = 0
        """Requests to the node so far."""

    async def of(self, holding: Holding, *, within: float = KEPT_POLLS, fresh: bool = False) -> Funding | None:
        """What is known of a holding, read `within` that many poll intervals, in the latest block, or now.

        None if the token can't be read. Raises `NodeUnreachable`.
        """
        known = self._known.get(holding)
        if known is not None and not fresh and self._is_current(known, within):
            return known.funding
        if holding not in self._asked:
            self._asked[holding] = asyncio.get_running_loop().create_future()
        asked = self._asked[holding]
        if self._asking is None:
            self._asking = asyncio.create_task(self._ask_all(), name="funds")
        return await asyncio.shield(asked)

    def _is_current(self, answer: _KnownFunding, within: float) -> bool:
        """Nothing changes between two blocks. But who is in a hurry may know of a block before we do."""
        heads, interval = self._contracts.node.heads, self._contracts.node.timing.poll_interval
        if within >= KEPT_POLLS and heads.are_timely and heads.latest and heads.latest.hash == answer.block:
            return True
        return self._clock.monotonic() < answer.asked_at + within * interval

    async def _ask_all(self) -> None:
        """Ask for what is wanted, `BATCH` at a time, until nothing is. What is wanted meanwhile comes next."""
        await asyncio.sleep(0)
        try:
            while self._asked:
                batch = list(self._asked)[:BATCH]
                await self._answer(batch)
        finally:
            self._asking = None
            for future in self._asked.values():
                future.cancel()
            self._asked.clear()

    async def _answer(self, batch: list[Holding]) -> None:
        asked_at, latest = self._clock.monotonic(), self._contracts.node.heads.latest
        block = None if latest is None else latest.hash
        futures = [self._asked.pop(holding) for holding in batch]
        try:
            answers = await self._read(batch)
        except Exception as error:
            for future in futures:
                if not future.cancelled():
                    future.set_exception(error)
                    future.exception()  # somebody may have stopped waiting
            return
        except asyncio.CancelledError:
            for future in futures:
                future.cancel()
            raise
        for holding, future, answer in zip(batch, futures, answers, strict=True):
            self._known.pop(holding, None)
            self._known[holding] = _KnownFunding(asked_at, block, answer)
            if not future.cancelled():
                future.set_result(answer)
        while len(self._known) > self._kept:
            self._known.popitem(last=False)

    async def _read(self, batch: Sequence[Holding]) -> list[Funding | None]:
        """What the node says; None for tokens that can't be read, and for all if the node refuses the request."""
        node, factory = self._contracts.node, self._contracts.factory
        self.requests += 1
        try:
            returned = await node.call({"data": "0x" + questions(batch, factory).hex()})
            return _answers(returned, len(batch))
        except (Reverted, RequestRefused, InvalidAnswer) as error:
            if len(batch) == 1:
                log.debug("the funds of %s can't be read: %s", batch[0], error)
                return [None]
        half = len(batch) // 2
        return [*await self._read(batch[:half]), *await self._read(batch[half:])]


def questions(batch: Sequence[Holding], spender: str) -> bytes:
    """EVM code that returns a zero word, and for each holding four words: is the balance valid, the balance, is the
    allowance of `spender` valid, the allowance."""
    code = bytearray()
    at = _ANSWERS + _WORD
    for holding in batch:
        for signature, arguments in (("70a08231", (holding.account,)), ("dd62ed3e", (holding.account, spender))):
            code += _call(holding.token, signature, arguments, at)
            at += 2 * _WORD
    # PUSH2 size, PUSH2 offset, RETURN
    code += b"\x61" + (at - _ANSWERS).to_bytes(2) + b"\x61" + _ANSWERS.to_bytes(2) + b"\xf3"
    return bytes(code)


def _call(token: str, signature: str, arguments: Sequence[str], at: int) -> bytes:
    """EVM code that calls a token, and writes to `at` whether it returned a word, and after it the word."""
    code = bytearray(b"\x63" + bytes.fromhex(signature) + bytes.fromhex("60e01b600052"))  # PUSH4, SHL 224, MSTORE at 0
    for number, argument in enumerate(arguments):
        code += b"\x73" + bytes.fromhex(argument[2:]) + bytes((0x60, 4 + _WORD * number, 0x52))  # PUSH20, MSTORE
    # The result's size and place, the question's size and place, the token and the gas: STATICCALL.
    code += b"\x60\x20\x61" + (at + _WORD).to_bytes(2) + bytes((0x60, 4 + _WORD * len(arguments), 0x60, 0))
    code += b"\x73" + bytes.fromhex(token[2:]) + b"\x62" + TOKEN_GAS.to_bytes(3) + b"\xfa"
    # RETURNDATASIZE, PUSH1 31, LT, AND, PUSH2, MSTORE
    return bytes(code) + bytes.fromhex("3d601f101661") + at.to_bytes(2) + b"\x52"


def _answers(returned: bytes, count: int) -> list[Funding | None]:
    if len(returned) != _WORD * (1 + 4 * count):
        raise InvalidAnswer("eth_call for funds", f"{len(returned)} bytes for {count} accounts")
    words = [int.from_bytes(returned[at : at + _WORD]) for at in range(_WORD, len(returned), _WORD)]
    return [
        Funding(words[at + 1], words[at + 3]) if words[at] and words[at + 2] else None for at in range(0, len(words), 4)
    ]
