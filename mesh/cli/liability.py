"""`aira liability`: lists and shows liabilities."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import XRT, Unit
from mesh.cli.chain_client import account_of, open_chain, own_address, units_of
from mesh.cli.files import FETCH_SETTINGS, fetch, opened_store
from mesh.cli.lazy import LazyGroup
from mesh.cli.options import ADDRESS, with_chain_settings, with_json, with_settings
from mesh.cli.output import plural, print_facts, print_json, print_line, print_table, printable, short_address
from mesh.cli.verdicts import CONNECT_TIMEOUT, reports_json, reports_on, verdict_facts
from mesh.errors import AiraError
from mesh.settings import ChainSettings, options_of
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.chain import Chain, RefundState
    from mesh.settings import Settings
    from mesh.work.notes import Reason
    from schemas.records import Liability
    from schemas.verdicts import ValidatorReport


FETCH_TIMEOUT: Final = 10.0
"""Seconds without a block of that recording after which it is given up."""
HEAD = ("LIABILITY", "STATE", "COST", "PROMISEE", "PROMISOR")


command = LazyGroup(
    "liability",
    help="""Liabilities: the contracts that hold the cost of a job until it is finalized.

    The promisee orders the work and pays; the promisor does it.""",
    lazy={
        "cancel": ("mesh.cli.liability_cancel:cancel", "cancel one by agreement, or refund it after the delay"),
        "watch": ("mesh.cli.liability_watch:watch", "follow one until it ends, or all of them"),
    },
)


@command.command("list", short_help="list the liabilities of an account, or all")
@click.option("--account", type=ADDRESS, help="address or ENS name of a promisee or promisor [the settings' account]")
@click.option("--all", "all_accounts", is_flag=True, help="list the liabilities of all accounts")
@click.option(
    "--state",
    type=click.Choice(["any", "open", "finalized"]),
    default="any",
    show_default=True,
    help="list only open liabilities, or only finalized ones",
)
@click.option(
    "--from-block",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="list only liabilities created at this block or later",
)
@with_json
@with_chain_settings()
async def list_liabilities(
    settings: Settings, *, account: str | None, all_accounts: bool, state: str, from_block: int, as_json: bool
) -> None:
    """List the liabilities of an account: first those in which it is the promisee, then those in which it is the
    promisor, each oldest first. Without an account in the settings, list all.

    Reading a long chain takes time; --from-block makes it faster.
    """
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        whose = (
            None if all_accounts or (account is None and own is None) else await account_of(chain, settings, account)
        )
        found = await _liabilities_of(chain, whose, from_block)
        if state != "any":
            found = [liability for liability in found if liability.is_finalized == (state == "finalized")]
        if as_json:
            print_json([liability_json(liability) for liability in found])
            return
        units = await units_of(chain, found)
    if not found:
        print_line(f"no {'' if state == 'any' else state + ' '}liabilities" + (f" of {whose}" if whose else ""))
        return
    rows = [
        (
            liability.address,
            state_of(liability),
            units[liability.token].show(liability.cost),
            short_address(liability.promisee, own=own),
            short_address(liability.promisor, own=own),
        )
        for liability in found
    ]
    print_table(HEAD, rows, numbers=("COST",))


async def _liabilities_of(chain: Chain, whose: str | None, from_block: int) -> Sequence[Liability]:
    """All liabilities, or those in which an account is promisee or promisor."""
    if whose is None:
        return await chain.liabilities.list(from_block=from_block)
    paid = await chain.liabilities.list(from_block=from_block, promisee=whose)
    worked = await chain.liabilities.list(from_block=from_block, promisor=whose)
    return list({liability.address: liability for liability in (*paid, *worked)}.values())


@command.command("show", short_help="show the parties, terms, cost and state of one")
@click.argument("address", type=ADDRESS)
@with_json
@with_settings(*dict.fromkeys((*FETCH_SETTINGS, "lighthouse_contract", *options_of(ChainSettings))))
async def show(settings: Settings, address: str, as_json: bool) -> None:
    """Show the liability at ADDRESS: its parties, terms, cost and state, and from which block it can be refunded.

    Of a job that failed, show also why, as its recording says; that is fetched if the store does not have it. If it
    names a validator, show how its jurors have judged, as those say that are on the mesh.
    """
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        await print_liability(chain, await chain.liabilities.get(address), settings, own=own, as_json=as_json)


async def print_liability(
    chain: Chain, liability: Liability, settings: Settings, *, own: str | None, as_json: bool
) -> None:
    """Print all facts about a liability; of a failed job also why it failed, and how its validator judged."""
    refund = await refund_state(chain, liability)
    reports = await reports_on(settings, chain, liability)
    failure = await _failure(settings, liability.result, reports or ()) if state_of(liability) == "failed" else None
    if as_json:
        facts = liability_json(liability) | {"refundableFrom": None if refund is None else refund.refundable_from}
        facts |= {} if liability.validator == ZERO_ADDRESS else {"reports": reports_json(reports)}
        print_json(facts if failure is None else facts | {"reason": failure.text, "code": failure.code})
        return
    units = await units_of(chain, [liability])
    words = None if refund is None else refund_words(refund)
    described = describe_liability(liability, units[liability.token], own=own, refundable=words)
    if failure is not None:
        described["reason"] = (
            f"{printable(failure.text)} ({failure.code})" if failure.text else "the recording has none"
        )
    print_facts(described | verdict_facts(reports or ()))


async def _failure(settings: Settings, result: str, reports: Sequence[ValidatorReport]) -> Reason:
    """Why a job failed, as its validator or its recording says."""
    from mesh.agent.judged_contract import refusal
    from mesh.work.notes import Reason, read_reason

    if (refused := refusal(reports)) is not None:
        return Reason(*refused)
    quick = replace(
        settings,
        connect_timeout=min(settings.connect_timeout, CONNECT_TIMEOUT),
        fetch_timeout=min(settings.fetch_timeout, FETCH_TIMEOUT),
    )
    try:
        async with opened_store(quick) as store:
            path = await fetch(quick, store, result, size_limit=settings.objective_expanded_limit)
            return await asyncio.to_thread(read_reason, path)
    except AiraError as error:
        return Reason(f"unknown, the recording is not available: {error}", "recording-unavailable")


async def refund_state(chain: Chain, liability: Liability) -> RefundState | None:
    """When an open liability can be refunded; None if it is finalized, or its contracts offer no refund."""
    from mesh.chain import NotOffered

    try:
        return None if liability.is_finalized else await chain.liabilities.refund_state(liability.address)
    except NotOffered:
        return None


def refund_words(refund: RefundState) -> str:
    """When the promisee can get a refund, for people."""
    if refund.is_refundable:
        return "possible now: `aira liability cancel --refund`"
    blocks = refund.refundable_from - refund.block_number
    return f"possible from block {refund.refundable_from:,}, in {plural(blocks, 'block')}"


OUTCOMES: Final[Mapping[str, str]] = {
    "open": "open: the contract holds the cost",
    "paid": "paid: the job was done, and the promisor was paid",
    "failed": "failed: the job was not done, and the cost was returned to the promisee",
    "called-off": "cancelled or refunded: there is no result, and the cost was returned to the promisee",
}
"""The states of a liability, and what they mean."""


def state_of(liability: Liability) -> str:
    """One of `OUTCOMES`."""
    if not liability.is_finalized:
        return "open"
    if liability.is_success:
        return "paid"
    return "failed" if liability.result else "called-off"


def liability_json(liability: Liability) -> dict[str, Any]:
    """A liability for JSON: its record as it is on the wire, and its state."""
    record: dict[str, Any] = json.loads(liability.encode())
    return record | {"state": state_of(liability)}


def describe_liability(
    liability: Liability, unit: Unit, *, own: str | None, refundable: str | None
) -> dict[str, str | None]:
    """A liability for people; `own` is the reader's address."""
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
