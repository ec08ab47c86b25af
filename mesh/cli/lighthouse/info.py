"""`aira lighthouse info`: one market, its providers, and whose turn it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.amounts import XRT
from mesh.cli.lighthouse.checks import find_lighthouse
from mesh.cli.lighthouse.words import facts_of
from mesh.cli.opening import for_reading, reading
from mesh.cli.printing import plural, print_facts, print_json, print_table, say, with_json
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.chain import LighthouseState
    from mesh.settings import Settings


@click.command("info")
@click.argument("name", required=False)
@with_json
@for_reading("lighthouse_contract")
def command(settings: Settings, name: str | None, as_json: bool) -> None:
    """Show a lighthouse (by default the settings'): its terms, its providers, and whose turn it is."""
    run_to_end(lambda: _info(settings, name or settings.lighthouse_contract, as_json))


async def _info(settings: Settings, name: str, as_json: bool) -> None:
    async with reading(settings) as chain:
        state = await chain.lighthouses.get(await find_lighthouse(chain, name))
        block = await chain.block_number()
        may_send = {provider: await chain.lighthouses.is_turn(state.address, provider) for provider in state.stakes}
    if as_json:
        facts = facts_of(name, state) | {"blockNumber": block}
        for provider in facts["providers"]:
            provider["maySend"] = may_send[provider["provider"]]
        print_json(facts)
    else:
        _say_info(name, state, block, may_send)


def _say_info(name: str, state: LighthouseState, block: int, may_send: dict[str, bool]) -> None:
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
        say()
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
        head = ("", "PROVIDER", "STAKE", "A TURN", "MAY SEND NOW")
        print_table(head, rows, numbers=("", "STAKE", "A TURN"))


def _turn(state: LighthouseState) -> str | None:
    """Whose turn it is, by address and place; None where nobody staked."""
    if not state.stakes:
        return None
    providers = list(state.stakes)
    place = f"{providers.index(state.current) + 1} of {len(providers)}" if state.current in providers else "left"
    return f"{state.current}  ({place}), {plural(state.quota, 'transaction')} left"
