"""`aira lighthouse`: lists, shows and creates lighthouses."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import XRT
from mesh.cli.chain_client import notice_when_slow, open_chain, open_signing_chain
from mesh.cli.errors import InvalidLighthouse, NameTaken, NotALighthouse
from mesh.cli.lazy import LazyGroup
from mesh.cli.options import with_chain_settings, with_json, with_lighthouse_options, with_signing_settings
from mesh.cli.output import plural, print_facts, print_json, print_line, print_table, printable

if TYPE_CHECKING:
    from mesh.chain import Chain, LighthouseState
    from mesh.settings import Settings


command = LazyGroup(
    "lighthouse",
    help="""List, show and create lighthouses (the markets); become a provider of one.

    Stakes are in XRT (1.5), or with the suffix wn in its smallest unit (1500000000wn). Name a lighthouse by its label
    (airalab), its ENS name or its address.""",
    lazy={
        "join": ("mesh.cli.lighthouse_stake:join", "become a provider by staking XRT"),
        "leave": ("mesh.cli.lighthouse_stake:leave", "withdraw the stake or a part of it"),
    },
)


@command.command("list", short_help="list all lighthouses")
@click.option(
    "--from-block",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="list only lighthouses created at this block or later",
)
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
    rows = [
        (
            printable(name),
            state.address,
            XRT.show(state.minimal_stake),
            plural(state.timeout_blocks, "block"),
            len(state.stakes),
            XRT.show(sum(state.stakes.values())),
        )
        for name, state in found
    ]
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
        block = await chain.block_number()
        may_send = {provider: await chain.lighthouses.is_turn(state.address, provider) for provider in state.stakes}
    if as_json:
        facts = lighthouse_json(name, state) | {"blockNumber": block}
        for provider in facts["providers"]:
            provider["maySend"] = may_send[provider["provider"]]
        print_json(facts)
    else:
        _print_info(name, state, block, may_send)


def _print_info(name: str, state: LighthouseState, block: int, may_send: dict[str, bool]) -> None:
    alive = state.keep_alive_block
    print_facts(
        {
            "lighthouse": state.address,
            "name": None if name == state.address else name,
            "minimal stake": XRT.show(state.minimal_stake),
            "timeout": plural(state.timeout_blocks, "block"),
            "turn": _turn(state),
            "last sign of life": f"block {alive:,}, {plural(block - alive, 'block')} ago" if alive else "none yet",
            "providers": None if state.stakes else "none; `aira lighthouse join` makes one",
        }
    )
    if state.stakes:
        print_line()
        rows = [
            (
                number,
                provider,
                XRT.show(stake),
                plural(stake // state.minimal_stake, "transaction"),
                "yes" if may_send[provider] else "no",
            )
            for number, (provider, stake) in enumerate(state.stakes.items(), 1)
        ]
        head = ("", "PROVIDER", "STAKE", "PER TURN", "MAY SEND NOW")
        print_table(head, rows, numbers=("", "STAKE", "PER TURN"))


def _turn(state: LighthouseState) -> str | None:
    """The provider whose turn it is, and its place; None if there is no provider."""
    if not state.stakes:
        return None
    providers = list(state.stakes)
    place = f"{providers.index(state.current) + 1} of {len(providers)}" if state.current in providers else "left"
    return f"{state.current}  ({place}), {plural(state.quota, 'transaction')} left"


@command.command("create", short_help="create a lighthouse")
@click.argument("name")
@with_lighthouse_options
@with_json
@with_signing_settings()
async def create(settings: Settings, *, name: str, minimal_stake: str, timeout_blocks: int, as_json: bool) -> None:
    """Create a lighthouse named NAME (1 to 32 characters of a to z, 0 to 9 and -, without - at the ends).

    Anyone can stake there as a provider."""
    stake = XRT.parse(minimal_stake)
    check_lighthouse(name, minimal_stake=stake)
    async with open_signing_chain(settings) as chain:
        full_name = f"{name}.lighthouse.{chain.generation}.robonomics.eth"
        await _check_free(chain, full_name)
        with notice_when_slow():
            made = await chain.lighthouses.create(minimal_stake=stake, timeout_blocks=timeout_blocks, name=name)
    if as_json:
        facts = {"lighthouse": made.lighthouse, "name": full_name, "minimalStake": str(stake)}
        print_json(facts | {"timeoutBlocks": timeout_blocks, "tx": made.tx})
        return
    print_facts(
        {
            "lighthouse": made.lighthouse,
            "name": full_name,
            "minimal stake": XRT.show(stake),
            "timeout": plural(timeout_blocks, "block"),
            "transaction": made.tx,
        }
    )


async def _check_free(chain: Chain, name: str) -> None:
    from mesh.chain import UnknownName

    try:
        taken = await chain.names.address(name)
    except UnknownName:
        return
    raise NameTaken(f"the name {name} is taken by {taken}", hint="choose another name")


LABEL: Final = re.compile(r"(?!-|..--)[a-z0-9-]{1,32}(?<!-)", re.ASCII)
"""Names that ENS clients leave as they are."""


LARGEST_STAKE: Final = 2**128 - 1


def check_lighthouse(name: str, *, minimal_stake: int) -> None:
    """Raise `InvalidLighthouse` for a name or a minimal stake (wn) that the factory would reject."""
    if not LABEL.fullmatch(name):
        raise InvalidLighthouse(
            f"{name[:40]!r} is not a valid name for a lighthouse",
            hint="use 1 to 32 of a to z, 0 to 9 and - (not at the ends, nor twice after two), such as `airalab`",
        )
    if not 1 <= minimal_stake <= LARGEST_STAKE:
        raise InvalidLighthouse(
            f"a minimal stake of {XRT.show(minimal_stake)} is out of range", hint="use at least 1 wn"
        )


async def find_lighthouse(chain: Chain, name: str) -> str:
    """The address of a lighthouse, by its label, ENS name or address.

    Raises `NotALighthouse`, `UnknownName`, `InvalidName`, `InvalidAddress`.
    """
    address = await chain.names.lighthouse(name)
    if not await chain.lighthouses.exists(address):
        raise NotALighthouse(f"{address} is not a lighthouse of this factory", hint="`aira lighthouse list` lists them")
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
