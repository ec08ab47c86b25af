"""Liabilities in words: how one stands, and what it is about."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

from mesh.cli.amounts import XRT, Unit
from mesh.cli.tokens import unit_of
from mesh.errors import ChainError
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mesh.chain import Chain
    from schemas.records import Liability

OUTCOMES: Final[Mapping[str, str]] = {
    "open": "open, the money is held",
    "paid": "paid: done, and the promisor has the money",
    "failed": "failed: not done, and the promisee has the money back",
    "called-off": "called off without a result, and the promisee has the money back",
}
"""Every state that a liability can be in, and what it means."""


def state_of(liability: Liability) -> str:
    """One of `OUTCOMES`."""
    if not liability.is_finalized:
        return "open"
    if liability.is_success:
        return "paid"
    return "failed" if liability.result else "called-off"


def facts_of(liability: Liability) -> dict[str, Any]:
    """A liability for programs: its record as it is on the wire, and its state in a word."""
    record: dict[str, Any] = json.loads(liability.encode())
    return record | {"state": state_of(liability)}


async def units_of(chain: Chain, liabilities: Iterable[Liability]) -> dict[str, Unit]:
    """The units of the tokens that liabilities are paid in, by the tokens' addresses.

    A token but XRT is named with its address, for it may call itself anything; one that says nothing counts in its
    smallest unit.
    """
    return {token: await _unit_of(chain, token) for token in {liability.token for liability in liabilities}}


async def _unit_of(chain: Chain, token: str) -> Unit:
    if token == chain.xrt:
        return await unit_of(chain, None)
    try:
        unit = await unit_of(chain, token)
    except ChainError:
        return Unit(f"units of {short(token)}", 0)
    return Unit(f"{unit.symbol} ({short(token)})", unit.decimals)


def spoken(liability: Liability, unit: Unit, *, own: str | None, refundable: str | None) -> dict[str, str | None]:
    """A liability as people read it, `own` being the address of who reads it."""
    is_judged = liability.validator != ZERO_ADDRESS
    fee = XRT.show(liability.validator_fee)
    return {
        "liability": liability.address,
        "state": OUTCOMES[state_of(liability)],
        "promisee": f"{liability.promisee}{'  (you)' if liability.promisee == own else ''}",
        "promisor": f"{liability.promisor}{'  (you)' if liability.promisor == own else ''}",
        "cost": unit.show(liability.cost),
        "token": liability.token,
        "model": liability.model,
        "objective": liability.objective,
        "result": liability.result or None,
        "lighthouse": f"{liability.lighthouse}  for {XRT.show(liability.lighthouse_fee)}",
        "validator": f"{liability.validator}  for {fee}" if is_judged else "none",
        "refund": refundable,
    }


def short(address: str, *, own: str | None = None) -> str:
    """An address in a table, in which another column is the one to copy from."""
    return "you" if address == own else f"{address[:6]}…{address[-4:]}"
