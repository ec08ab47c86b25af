"""Lighthouses for programs, and what an account has at one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.cli.amounts import XRT
from mesh.cli.printing import plural, print_facts, print_json

if TYPE_CHECKING:
    from mesh.chain import LighthouseState


def facts_of(name: str, state: LighthouseState) -> dict[str, Any]:
    """A lighthouse, for programs: stakes in wn."""
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


def print_stake(name: str, address: str, state: LighthouseState, *, as_json: bool) -> None:
    """Print what an account has at the lighthouse that goes by `name`, after all."""
    stake = state.stakes.get(address, 0)
    quota = stake // state.minimal_stake
    if as_json:
        facts = {"lighthouse": state.address, "name": name, "provider": address}
        print_json(facts | {"stake": str(stake), "quota": quota, "isProvider": address in state.stakes})
        return
    print_facts(
        {
            "lighthouse": f"{state.address}  {name}",
            "provider": f"{address}{'' if stake else '  (no more)'}",
            "stake": XRT.show(stake),
            "a turn": plural(quota, "transaction") if stake else None,
        }
    )
