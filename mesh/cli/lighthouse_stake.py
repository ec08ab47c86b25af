"""`aira lighthouse join` and `leave`: the stake that makes an account a provider."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.amounts import AMOUNT, XRT, InvalidAmount
from mesh.cli.chain_client import check_balance, notice_when_slow, open_signing_chain
from mesh.cli.errors import InvalidOptions, InvalidStake, NotAProvider
from mesh.cli.lighthouse import find_lighthouse
from mesh.cli.options import with_json, with_signing_settings
from mesh.cli.output import plural, print_facts, print_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import LighthouseState
    from mesh.settings import Settings


@click.command("join")
@click.argument("words", nargs=-1, required=True, metavar="[LIGHTHOUSE] VALUE")
@with_json
@with_signing_settings("lighthouse_contract")
async def join(settings: Settings, words: tuple[str, ...], as_json: bool) -> None:
    """Add VALUE to the stake at LIGHTHOUSE (by default that of the settings), to become one of its providers.

    Approves the amount for the lighthouse first if necessary. Each minimal stake allows one transaction per turn.
    """
    name, value = lighthouse_and_value(words, settings)
    if value is None:
        raise InvalidOptions("VALUE is missing", hint=f"for example: `aira lighthouse join {name} 20`")
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
    """Raise `InvalidStake` for a stake that the lighthouse would reject."""
    hint = f"stake {XRT.show(max(1, state.minimal_stake - staked))} or more"
    if not added:
        raise InvalidStake("the stake to add must be more than 0", hint=hint)
    if staked + added < state.minimal_stake:
        minimum = XRT.show(state.minimal_stake)
        raise InvalidStake(f"a stake of {XRT.show(staked + added)} is below the minimum of {minimum}", hint=hint)


@click.command("leave")
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
            raise NotAProvider(f"{me} has no stake at {name}", hint=f"see `aira lighthouse info {name}`")
        if value is not None and not 0 < value <= staked:
            raise InvalidStake(
                f"can't withdraw {XRT.show(value)} from a stake of {XRT.show(staked)}",
                hint="omit VALUE to withdraw all of it",
            )
        with notice_when_slow():
            await chain.lighthouses.withdraw(state.address, staked if value is None else value)
        state = await chain.lighthouses.get(state.address)
    print_stake(name, me, state, as_json=as_json)


def lighthouse_and_value(words: Sequence[str], settings: Settings) -> tuple[str, int | None]:
    """Parse `[LIGHTHOUSE] [VALUE]`: a name, by default the settings', and an amount in wn, if one is given.

    One word alone is a VALUE if it looks like one. Raises `InvalidAmount`, `InvalidOptions`.
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
    raise InvalidOptions("too many arguments", hint="give a LIGHTHOUSE and a VALUE")


def print_stake(name: str, address: str, state: LighthouseState, *, as_json: bool) -> None:
    """Print the stake of an account at the lighthouse with this `name`."""
    stake = state.stakes.get(address, 0)
    quota = stake // state.minimal_stake
    if as_json:
        facts = {"lighthouse": state.address, "name": name, "provider": address}
        print_json(facts | {"stake": str(stake), "quota": quota, "isProvider": address in state.stakes})
        return
    print_facts(
        {
            "lighthouse": f"{state.address}  {name}",
            "provider": f"{address}{'' if stake else '  (no longer a provider)'}",
            "stake": XRT.show(stake),
            "per turn": plural(quota, "transaction") if stake else None,
        }
    )
