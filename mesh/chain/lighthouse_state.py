"""The state of a lighthouse: its rules, its turn, and its providers with their stakes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.chain.answers import InvalidAnswer
from schemas.address import ZERO_ADDRESS, parse_address

if TYPE_CHECKING:
    from mesh.chain.node import Node

MAX_PROVIDERS: Final = 10_000
"""Providers of one lighthouse that are read."""

PAGE: Final = 250
"""Providers that one call of ours returns, at about 5,000 gas each."""


class LighthouseGetters(NamedTuple):
    """The names of a lighthouse's getters, and how its turns are counted."""

    length: str
    at: str
    stake: str
    rules: tuple[str, str, str, str]
    """Minimal stake, timeout, the block of the last transaction, and the quota that is left."""

    first: int
    """The marker of the first provider."""


GETTERS: Final = {
    3: LighthouseGetters(
        "membersLength", "members", "balances", ("minimalFreeze", "timeoutBlocks", "keepaliveBlock", "quota"), first=0
    ),
    5: LighthouseGetters(
        "providersLength",
        "providers",
        "stakes",
        ("minimalStake", "timeoutInBlocks", "keepAliveBlock", "quota"),
        first=1,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LighthouseState:
    """The state of a lighthouse. Stakes are wn, `timeout_blocks` and `keep_alive_block` count blocks."""

    address: str
    minimal_stake: int
    timeout_blocks: int
    keep_alive_block: int
    """The block of the last transaction, from which silence counts."""

    quota: int
    """How many transactions are left in the turn."""

    current: str
    """The provider that has the turn; the zero address if there is none."""

    stakes: dict[str, int]
    """Providers and their stakes, in the order of their turns; ours begin with the current one."""


async def lighthouse_state(node: Node, address: str) -> LighthouseState:
    """The state of a lighthouse of ours, as of one block.

    Raises `NoContracts` if there is none, `InvalidAnswer` if it has too many providers, `NodeUnreachable`.
    """
    functions = node.contract("Lighthouse", address)
    rules = [functions[name]() for name in (*GETTERS[5].rules, "current")]
    (*first, rest), *values = await node.read_all((functions.queue(ZERO_ADDRESS, PAGE), *rules), block="latest")
    if rest == ZERO_ADDRESS:
        return _state(address, values[:-1], values[-1], _paged({}, *first, address=address))
    block = await node.block_number()
    stakes = await _queue(node, address, block)
    *values, current = await node.read_all(rules, block=block)
    return _state(address, values, current, stakes)


async def original_state(node: Node, address: str, names: LighthouseGetters) -> LighthouseState:
    """The state of an original lighthouse, whose list of providers is in the order of turns. Raises as above."""
    block = await node.block_number()
    functions = node.contract("Lighthouse", address)
    count = await node.read(functions[names.length](), block=block)
    _check_count(address, count)
    found = await node.read_all((functions[names.at](index) for index in range(count)), block=block)
    stakes = await node.read_all((functions[names.stake](provider) for provider in found), block=block)
    *rules, marker = await node.read_all((functions[name]() for name in (*names.rules, "marker")), block=block)
    current = found[(marker - names.first) % count] if count else ZERO_ADDRESS
    by_provider = {parse_address(provider): stake for provider, stake in zip(found, stakes, strict=True)}
    return _state(address, rules, current, by_provider)


def _state(address: str, rules: list[int], current: str, stakes: dict[str, int]) -> LighthouseState:
    minimal_stake, timeout_blocks, keep_alive_block, quota = rules
    return LighthouseState(
        address=address,
        minimal_stake=minimal_stake,
        timeout_blocks=timeout_blocks,
        keep_alive_block=keep_alive_block,
        quota=quota,
        current=parse_address(current),
        stakes=stakes,
    )


async def _queue(node: Node, address: str, block: int) -> dict[str, int]:
    """The providers of a lighthouse of ours and their stakes, from the current one on."""
    functions = node.contract("Lighthouse", address)
    stakes: dict[str, int] = {}
    first = ZERO_ADDRESS
    while not stakes or first != ZERO_ADDRESS:
        accounts, staked, first = await node.read(functions.queue(first, PAGE), block=block)
        if not accounts and not stakes:
            break
        if not accounts:
            raise InvalidAnswer(f"queue of {address}", "an empty page")
        stakes = _paged(stakes, accounts, staked, address=address)
    return stakes


def _paged(stakes: dict[str, int], accounts: list[str], staked: list[int], *, address: str) -> dict[str, int]:
    """The stakes with those of another page. Raises `InvalidAnswer`."""
    paged = stakes | {parse_address(account): stake for account, stake in zip(accounts, staked, strict=False)}
    if len(paged) != len(stakes) + len(accounts) or len(accounts) != len(staked):
        raise InvalidAnswer(f"queue of {address}", "a page with providers twice, or without their stakes")
    _check_count(address, len(paged))
    return paged


def _check_count(address: str, count: int) -> None:
    if count > MAX_PROVIDERS:
        raise InvalidAnswer(f"providers of {address}", f"{count} providers, and {MAX_PROVIDERS} are read at most")
