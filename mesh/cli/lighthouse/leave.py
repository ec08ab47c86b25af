"""`aira lighthouse leave`: a stake taken back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.amounts import XRT
from mesh.cli.lighthouse.checks import find_lighthouse, lighthouse_and_value
from mesh.cli.lighthouse.words import print_stake
from mesh.cli.opening import for_signing, patience, signing
from mesh.cli.printing import with_json
from mesh.errors import ChainError, InputError
from mesh.running import run_to_end

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.settings import Settings


@click.command("leave")
@click.argument("words", nargs=-1, metavar="[LIGHTHOUSE] [VALUE]")
@with_json
@for_signing("lighthouse_contract")
def command(settings: Settings, words: tuple[str, ...], as_json: bool) -> None:
    """Take VALUE off the stake at LIGHTHOUSE (by default the settings').

    Without VALUE, or when less than the minimum would remain, all of it is taken. Who has no stake is no provider any
    more.
    """
    run_to_end(lambda: _leave(settings, words, as_json))


async def _leave(settings: Settings, words: Sequence[str], as_json: bool) -> None:
    name, value = lighthouse_and_value(words, settings)
    async with signing(settings) as chain:
        assert chain.account is not None
        me = chain.account.address
        state = await chain.lighthouses.get(await find_lighthouse(chain, name))
        staked = state.stakes.get(me)
        if staked is None:
            raise ChainError(f"{me} has no stake at {name}", hint=f"see `aira lighthouse info {name}`")
        if value is not None and not 0 < value <= staked:
            raise InputError(
                f"{XRT.show(value)} can't be taken off a stake of {XRT.show(staked)}", hint="without VALUE all is taken"
            )
        with patience():
            await chain.lighthouses.withdraw(state.address, staked if value is None else value)
        state = await chain.lighthouses.get(state.address)
    print_stake(name, me, state, as_json=as_json)
