"""`aira lighthouse join`: a stake, and with it a part in the turns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.amounts import XRT
from mesh.cli.lighthouse.checks import find_lighthouse, lighthouse_and_value
from mesh.cli.lighthouse.words import print_stake
from mesh.cli.opening import for_signing, patience, signing
from mesh.cli.printing import with_json
from mesh.cli.tokens import check_enough
from mesh.errors import InputError
from mesh.running import run_to_end

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import LighthouseState
    from mesh.settings import Settings


@click.command("join")
@click.argument("words", nargs=-1, required=True, metavar="[LIGHTHOUSE] VALUE")
@with_json
@for_signing("lighthouse_contract")
def command(settings: Settings, words: tuple[str, ...], as_json: bool) -> None:
    """Stake VALUE at LIGHTHOUSE (by default the settings'), on top of what is staked already, and be its provider.

    What the lighthouse is not yet allowed to take is approved first. Each minimal stake is one transaction a turn.
    """
    run_to_end(lambda: _join(settings, words, as_json))


async def _join(settings: Settings, words: Sequence[str], as_json: bool) -> None:
    name, value = lighthouse_and_value(words, settings)
    if value is None:
        raise InputError("a VALUE is missing, what is to be staked", hint=f"say so: `aira lighthouse join {name} 20`")
    async with signing(settings) as chain:
        assert chain.account is not None
        state = await chain.lighthouses.get(await find_lighthouse(chain, name))
        staked = state.stakes.get(chain.account.address, 0)
        _check_stake(state, staked=staked, added=value)
        await check_enough(chain, XRT, value)
        with patience():
            state = await chain.lighthouses.become_provider(state.address, staked + value)
    print_stake(name, chain.account.address, state, as_json=as_json)


def _check_stake(state: LighthouseState, *, staked: int, added: int) -> None:
    """Raise `InputError` for a stake that the lighthouse would refuse."""
    hint = f"stake {XRT.show(max(1, state.minimal_stake - staked))} or more"
    if not added:
        raise InputError("a stake of nothing can't be added", hint=hint)
    if staked + added < state.minimal_stake:
        minimum = XRT.show(state.minimal_stake)
        raise InputError(f"a stake of {XRT.show(staked + added)} is below the minimum of {minimum}", hint=hint)
