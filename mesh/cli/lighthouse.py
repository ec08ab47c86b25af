"""`aira lighthouse`: lists and creates lighthouses; joins and leaves one as a provider."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import AMOUNT, XRT, InvalidAmount
from mesh.cli import LazyGroup
from mesh.cli.chain_client import check_balance, notice_when_slow, open_chain, open_signing_chain
from mesh.cli.options import (
    with_chain_settings,
    with_first_block,
    with_json,
    with_lighthouse_options,
    with_signing_settings,
)
from mesh.cli.output import plural, print_facts, print_json, print_line, print_result, print_table, printable
from mesh.errors import ChainError, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import Chain, LighthouseState
    from mesh.settings import Settings


command = LazyGroup(
    "lighthouse",
    help="""List, show and create lighthouses (the markets); become a provider of one.

    Stakes are in XRT (1.5), or with the suffix wn in its smallest unit (1500000000wn). Name a lighthouse by its label
    (airalab), its ENS name or its address.""",
)


@command.command("list", short_help="list all lighthouses")
@with_first_block("list only lighthouses created at this block or later")
@with_json
@with_chain_settings()
async def list_lighthouses(settings: Settings, from_block: int, as_json: bool) -> None:
    """List all lighthouses of the factory, oldest first."""
    async with open_chain(settings) as chain:
        found = [
            (made.name, await chain.lighthouses.get(made.lighthouse))
            for made in await chain.lighthouses.list(from_block=from_block)
        ]
    if as_json:
        print_json([lighthouse_json(name, state) for name, state in found])
        return
    rows = []
    for name, state in found:
        rules = XRT.show(state.minimal_stake), plural(state.timeout_blocks, "block")
        staked = len(state.stakes), XRT.show(sum(state.stakes.values()))
        rows.append((printable(name), state.address, *rules, *staked))
    if rows:
        head = ("NAME", "ADDRESS", "MINIMAL STAKE", "TIMEOUT", "PROVIDERS", "STAKED")
        print_table(head, rows, numbers=head[2:])
    else:
        print_line("there is no lighthouse" + (f" since block {from_block:,}" if from_block else ""))


@command.command("info", short_help="show the rules, the providers and the turn of one")
@click.argument("name", required=False)
@with_json
@with_chain_settings("lighthouse_contract")
async def info(settings: Settings, name: str | None, as_json: bool) -> None:
    """Show a lighthouse (by default that of the settings): its rules, its providers, and whose turn it is."""
    name = name or settings.lighthouse_contract
    async with open_chain(settings) as chain:
        state = await chain.lighthouses.get(await find_lighthouse(chain, name))
        block = await chain.contract_block()
        may_send = {provider: await chain.lighthouses.is_turn(state.address, provider) for provider in state.stakes}
    if as_json:
        facts = lighthouse_json(name, state) | {"blockNumber": block}
        for provider in facts["providers"]:
            provider["maySend"] = may_send[provider["provider"]]
        print_json(facts)
    else:
        _print_info(name, state, block, may_send)


def _print_info(name: str, state: LighthouseState, block: int, may_send: dict[str, bool]) -> None:
    alive, turn, providers = state.keep_alive_block, None, list(state.stakes)
    if providers:
        place = f"{providers.index(state.current) + 1} of {len(providers)}" if state.current in providers else "left"
        turn = f"{state.current}  ({place}), {plural(state.quota, 'transaction')} left"
    print_facts(
        {
            "lighthouse": state.address,
            "name": None if name == state.address else name,
            "minimal stake": XRT.show(state.minimal_stake),
            "timeout": plural(state.timeout_blocks, "block"),
            "turn": turn,
            "last sign of life": f"block {alive:,}, {plural(block - alive, 'block')} ago" if alive else "none yet",
            "providers": None if state.stakes else "none; `aira lighthouse join` makes one",
        }
    )
    if state.stakes:
        print_line()
        rows = []
        for number, (provider, stake) in enumerate(state.stakes.items(), 1):
            quota = plural(stake // state.minimal_stake, "transaction")
            rows.append((number, provider, XRT.show(stake), quota, "yes" if may_send[provider] else "no"))
        head = ("", "PROVIDER", "STAKE", "PER TURN", "MAY SEND NOW")
        print_table(head, rows, numbers=("", "STAKE", "PER TURN"))


@command.command("create", short_help="create a lighthouse")
@click.argument("name")
@with_lighthouse_options
@with_json
@with_signing_settings()
async def create(settings: Settings, *, name: str, minimal_stake: str, timeout_blocks: int, as_json: bool) -> None:
    """Create a lighthouse named NAME (1 to 32 characters of a to z, 0 to 9 and -, without - at the ends).

    Anyone can stake there as a provider."""
    from mesh.chain import UnknownName

    stake = XRT.parse(minimal_stake)
    check_lighthouse(name, minimal_stake=stake)
    async with open_signing_chain(settings) as chain:
        full_name = f"{name}.lighthouse.{chain.generation}.robonomics.eth"
        with suppress(UnknownName):
            taken = await chain.names.address(full_name)
            raise ChainError(f"the name {full_name} is taken by {taken}", hint="choose another name", code="name-taken")
        with notice_when_slow():
            made = await chain.lighthouses.create(minimal_stake=stake, timeout_blocks=timeout_blocks, name=name)
    about = {"lighthouse": made.lighthouse, "name": full_name}
    facts = {"minimal stake": XRT.show(stake), "timeout": plural(timeout_blocks, "block"), "transaction": made.tx}
    result = {"minimalStake": str(stake), "timeoutBlocks": timeout_blocks, "tx": made.tx}
    print_result(about | result, about | facts, as_json=as_json)


LABEL: Final = re.compile(r"(?!-|..--)[a-z0-9-]{1,32}(?<!-)", re.ASCII)
"""Names that ENS clients leave as they are."""


def check_lighthouse(name: str, *, minimal_stake: int) -> None:
    """Raise `InputError` for a name or a minimal stake (wn) that the factory would reject."""
    if not LABEL.fullmatch(name):
        raise InputError(
            f"{name[:40]!r} is not a valid name for a lighthouse",
            hint="use 1 to 32 of a to z, 0 to 9 and - (not at the ends, nor twice after two), such as `airalab`",
            code="invalid-lighthouse",
        )
    if not 1 <= minimal_stake < 2**128:
        raise InputError(
            f"a minimal stake of {XRT.show(minimal_stake)} is out of range",
            hint="use at least 1 wn",
            code="invalid-lighthouse",
        )


async def find_lighthouse(chain: Chain, name: str) -> str:
    """The address of a lighthouse, by its label, ENS name or address.

    Raises `ChainError`, `UnknownName`, `InputError`.
    """
    address = await chain.names.lighthouse(name)
    if not await chain.lighthouses.exists(address):
        raise ChainError(
            f"{address} is not a lighthouse of this factory",
            hint="`aira lighthouse list` lists them",
            code="not-a-lighthouse",
        )
    return address


def lighthouse_json(name: str, state: LighthouseState) -> dict[str, Any]:
    """A lighthouse for JSON: stakes are text, in wn."""
    providers = list(state.stakes)
    return {
        "lighthouse": state.address,
        "name": name,
        "minimalStake": str(state.minimal_stake),
        "timeoutBlocks": state.timeout_blocks,
        "keepAliveBlock": state.keep_alive_block,
        "current": state.current if providers else None,
        "marker": providers.index(state.current) + 1 if state.current in providers else 0,
        "quota": state.quota,
        "providers": [
            {"provider": provider, "stake": str(stake), "quota": stake // state.minimal_stake}
            for provider, stake in state.stakes.items()
        ],
    }


@command.command("join", short_help="become a provider by staking XRT")
@click.argument("words", nargs=-1, required=True, metavar="[LIGHTHOUSE] VALUE")
@with_json
@with_signing_settings("lighthouse_contract")
async def join(settings: Settings, words: tuple[str, ...], as_json: bool) -> None:
    """Add VALUE to the stake at LIGHTHOUSE (by default that of the settings), to become one of its providers.

    Approves the amount for the lighthouse first if necessary. Each minimal stake allows one transaction per turn.
    """
    name, value = lighthouse_and_value(words, settings)
    if value is None:
        raise InputError(
            "VALUE is missing", hint=f"for example: `aira lighthouse join {name} 20`", code="invalid-options"
        )
    async with open_signing_chain(settings) as chain:
        assert chain.account is not None
        state = await chain.lighthouses.get(await find_lighthouse(chain, name))
        staked = state.stakes.get(chain.account.address, 0)
        _check_stake(state, staked=staked, added=value)
        await check_balance(chain, XRT, value)
        with notice_when_slow():
            state = await chain.lighthouses.become_provider(state.address, staked + value)
    print_stake(name, chain.account.address, state, as_json=as_json)


def _check_stake(state: LighthouseState, *, staked: int, added: int) -> None:
    """Raise `InputError` for a stake that the lighthouse would reject."""
    hint = f"stake {XRT.show(max(1, state.minimal_stake - staked))} or more"
    if not added:
        raise InputError("the stake to add must be more than 0", hint=hint, code="invalid-stake")
    if staked + added < state.minimal_stake:
        minimum = XRT.show(state.minimal_stake)
        raise InputError(
            f"a stake of {XRT.show(staked + added)} is below the minimum of {minimum}", hint=hint, code="invalid-stake"
        )


@command.command("leave", short_help="withdraw the stake or a part of it")
@click.argument("words", nargs=-1, metavar="[LIGHTHOUSE] [VALUE]")
@with_json
@with_signing_settings("lighthouse_contract")
async def leave(settings: Settings, words: tuple[str, ...], as_json: bool) -> None:
    """Withdraw VALUE from the stake at LIGHTHOUSE (by default that of the settings).

    Without VALUE, or if less than the minimum would remain, withdraw all of it. Without a stake you stop being a
    provider.
    """
    name, value = lighthouse_and_value(words, settings)
    async with open_signing_chain(settings) as chain:
        assert chain.account is not None
        me = chain.account.address
        state = await chain.lighthouses.get(await find_lighthouse(chain, name))
        staked = state.stakes.get(me)
        if staked is None:
            raise ChainError(
                f"{me} has no stake at {name}", hint=f"see `aira lighthouse info {name}`", code="not-a-provider"
            )
        if value is not None and not 0 < value <= staked:
            raise InputError(
                f"can't withdraw {XRT.show(value)} from a stake of {XRT.show(staked)}",
                hint="omit VALUE to withdraw all of it",
                code="invalid-stake",
            )
        with notice_when_slow():
            await chain.lighthouses.withdraw(state.address, staked if value is None else value)
        state = await chain.lighthouses.get(state.address)
    print_stake(name, me, state, as_json=as_json)


def lighthouse_and_value(words: Sequence[str], settings: Settings) -> tuple[str, int | None]:
    """Parse `[LIGHTHOUSE] [VALUE]`: a name, by default the settings', and an amount in wn, if one is given.

    One word alone is a VALUE if it looks like one. Raises `InvalidAmount`, `InputError`.
    """
    match words:
        case ():
            return settings.lighthouse_contract, None
        case (word,) if AMOUNT.fullmatch(word):
            return settings.lighthouse_contract, XRT.parse(word)
        case (name,):
            return name, None
        case (value, name) if AMOUNT.fullmatch(value) and not AMOUNT.fullmatch(name):
            raise InvalidAmount(f"{name!r} is not an amount", hint=f"the lighthouse comes first: {name} {value}")
        case (name, value):
            return name, XRT.parse(value)
    raise InputError("too many arguments", hint="give a LIGHTHOUSE and a VALUE", code="invalid-options")


def print_stake(name: str, address: str, state: LighthouseState, *, as_json: bool) -> None:
    """Print the stake of an account at the lighthouse with this `name`."""
    stake = state.stakes.get(address, 0)
    quota = stake // state.minimal_stake
    result: dict[str, Any] = {"lighthouse": state.address, "name": name, "provider": address}
    result |= {"stake": str(stake), "quota": quota, "isProvider": address in state.stakes}
    facts = {
        "lighthouse": f"{state.address}  {name}",
        "provider": f"{address}{'' if stake else '  (no longer a provider)'}",
        "stake": XRT.show(stake),
        "per turn": plural(quota, "transaction") if stake else None,
    }
    print_result(result, facts, as_json=as_json)
