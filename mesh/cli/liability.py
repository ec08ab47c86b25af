"""`aira liability`: lists, shows, follows, stops, cancels and claims what liabilities hold."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from contextlib import aclosing
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import XRT, Unit
from mesh.base.background import Background
from mesh.base.outage_log import OutageLog
from mesh.chain import permit_fee
from mesh.chain.errors import Reverted
from mesh.chain.liabilities import cost_receiver
from mesh.cli import LazyGroup
from mesh.cli.chain_client import account_of, notice_when_slow, open_chain, open_signing_chain, own_address, units_of
from mesh.cli.files import FETCH_SETTINGS, fetch, opened_store
from mesh.cli.options import (
    ADDRESS,
    with_chain_settings,
    with_first_block,
    with_json,
    with_settings,
    with_signing_settings,
)
from mesh.cli.output import (
    format_time,
    iso_time,
    plural,
    print_facts,
    print_json,
    print_line,
    print_result,
    print_table,
    printable,
    short_address,
)
from mesh.cli.validator import CONNECT_TIMEOUT, print_verdicts, reports_json, reports_on, verdict_facts
from mesh.errors import AiraError, ChainError, InputError, InvalidMessage, RemoteError
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from schemas.address import ZERO_ADDRESS
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.agent.jobs import Reason
    from mesh.chain import BlockEvents, Chain, Dated, Mined, RefundState, Settled
    from mesh.chain.transactions import Receipt
    from mesh.settings import Settings
    from schemas.records import Liability
    from schemas.rpc import Stopped
    from schemas.verdicts import ValidatorReport


log = logging.getLogger(__name__)


command = LazyGroup(
    "liability",
    help="""Liabilities: the contracts that hold the cost of a job until it is finalized.

    The promisee orders the work and pays; the promisor does it.""",
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
@with_first_block("list only liabilities created at this block or later")
@with_json
@with_chain_settings()
async def list_liabilities(
    settings: Settings, *, account: str | None, all_accounts: bool, state: str, from_block: int, as_json: bool
) -> None:
    """List the liabilities of an account with the times of their creation and their end (UTC), oldest first, and the
    sums of their costs. Without an account in the settings, list all. `aira statement` has fees and gas.

    Reading a long chain takes time; --from-block makes it faster.
    """
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        is_any = all_accounts or (account is None and own is None)
        whose = "" if is_any else await account_of(chain, settings, account)
        found = [
            dated
            for dated in await chain.liabilities.history(from_block=from_block, party=whose)
            if dated.created.block_number >= from_block
            and (state == "any" or dated.liability.is_finalized == (state == "finalized"))
        ]
        if as_json:
            print_json([dated_json(dated) for dated in found])
            return
        units = await units_of(chain, [dated.liability for dated in found])
    if not found:
        print_line(f"no {'' if state == 'any' else state + ' '}liabilities" + (f" of {whose}" if whose else ""))
        return
    rows = []
    costs: Counter[tuple[str, str]] = Counter()
    for dated in found:
        one = dated.liability
        parties = short_address(one.promisee, own=own), short_address(one.promisor, own=own)
        times = format_time(dated.created.time), format_time(dated.ended.time) if dated.ended else "-"
        rows.append((*times, one.address, one.state, units[one.token].show(one.cost), *parties))
        costs[one.state, one.token] += one.cost
    print_table(("CREATED", "ENDED", "LIABILITY", "STATE", "COST", "PROMISEE", "PROMISOR"), rows, numbers=("COST",))
    for (word, token), cost in sorted(costs.items()):
        number = sum(dated.liability.state == word and dated.liability.token == token for dated in found)
        print_line(f"{plural(number, 'contract')} {word}: {units[token].show(cost)}")


def dated_json(dated: Dated) -> dict[str, Any]:
    """A liability for JSON, with the transactions that created and ended it."""
    return liability_json(dated.liability) | {"created": _mined_json(dated.created), "ended": _mined_json(dated.ended)}


def _mined_json(mined: Mined | None) -> dict[str, Any] | None:
    if mined is None:
        return None
    return {"time": iso_time(mined.time), "block": mined.block_number, "tx": mined.tx}


@command.command("show", short_help="show the parties, terms, cost and state of one")
@click.argument("address", type=ADDRESS)
@with_json
@with_settings(*FETCH_SETTINGS, "lighthouse_contract", ChainSettings)
async def show(settings: Settings, address: str, as_json: bool) -> None:
    """Show the liability at ADDRESS: its parties, terms, cost and state, and from which block it can be refunded.

    If the token refused to pay the cost at the end, show what is owed now, and to whom.

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
    owed = await chain.liabilities.owed_after(liability)
    reports = await reports_on(settings, chain, liability)
    failure = await _failure(settings, liability.result, reports or ()) if liability.state == "failed" else None
    if as_json:
        facts = liability_json(liability) | {"refundableFrom": None if refund is None else refund.refundable_from}
        facts |= {"owed": str(owed)} if owed else {}
        facts |= {} if liability.validator == ZERO_ADDRESS else {"reports": reports_json(reports)}
        print_json(facts if failure is None else facts | {"reason": failure.text, "code": failure.code})
        return
    units = await units_of(chain, [liability])
    words = None if refund is None else refund_words(refund)
    described = describe_liability(liability, units[liability.token], own=own, refundable=words)
    if owed:
        described["owed"] = owed_words(liability, units[liability.token], owed)
    if chain.node.profile.explorer:
        described["explorer"] = f"{chain.node.profile.explorer}/address/{liability.address}"
    if failure is not None:
        text = f"{printable(failure.text)} ({failure.code})"
        described["reason"] = text if failure.text else "the recording has none"
    print_facts(described | verdict_facts(reports or ()))


async def _failure(settings: Settings, result: str, reports: Sequence[ValidatorReport]) -> Reason:
    """Why a job failed, as its validator or its recording says."""
    from mesh.agent.contracts import refusal
    from mesh.agent.jobs import Reason, read_reason

    if (refused := refusal(reports)) is not None:
        return Reason(*refused)
    quick = replace(
        settings,
        connect_timeout=min(settings.connect_timeout, CONNECT_TIMEOUT),
        fetch_timeout=min(settings.fetch_timeout, 10.0),
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
    blocks = refund.refundable_from - refund.contract_block
    return f"possible from block {refund.refundable_from:,}, in {plural(blocks, 'block')}"


def owed_words(liability: Liability, unit: Unit, owed: int) -> str:
    """What is owed to whom because the token refused to pay it, and how to take it, for people."""
    command = f"aira liability claim {liability.address}"
    return f"{unit.show(owed)} to {cost_receiver(liability)}, whom the token refused to pay: `{command}`"


OUTCOMES: Final[Mapping[str, str]] = {
    "open": "open: the contract holds the cost",
    "paid": "paid: the job was done, and the promisor was paid",
    "failed": "failed: the job was not done, and the cost was returned to the promisee",
    "called-off": "cancelled or refunded: there is no result, and the cost was returned to the promisee",
}
"""The states of a liability, and what they mean."""


def liability_json(liability: Liability) -> dict[str, Any]:
    """A liability for JSON: its record as it is on the wire, and its state."""
    record: dict[str, Any] = decode_json(liability.encode())
    return record | {"state": liability.state}


def describe_liability(
    liability: Liability, unit: Unit, *, own: str | None, refundable: str | None
) -> dict[str, str | None]:
    """A liability for people; `own` is the reader's address."""
    is_judged = liability.validator != ZERO_ADDRESS
    fee = permit_fee(liability)
    return {
        "liability": liability.address,
        "state": OUTCOMES[liability.state],
        "promisee": f"{liability.promisee}{'  (you)' if liability.promisee == own else ''}",
        "promisor": f"{liability.promisor}{'  (you)' if liability.promisor == own else ''}",
        "cost": unit.show(liability.cost),
        "token": liability.token,
        "model": liability.model,
        "objective": liability.objective,
        "result": liability.result or None,
        "lighthouse": f"{liability.lighthouse}  for {XRT.show(liability.lighthouse_fee)}",
        "validator": f"{liability.validator}  for {XRT.show(liability.validator_fee)}" if is_judged else "none",
        "permit": f"{unit.show(fee)} to the provider, if it was created with one" if fee else None,
        "refund": refundable,
    }


@command.command("cancel", short_help="cancel one by agreement, or refund it after the delay")
@click.argument("address", type=ADDRESS)
@click.option("--signature", "signatures", multiple=True, help="a party's signature, as its own command printed it")
@click.option("--refund", is_flag=True, help="refund the promisee after the refund delay, without signatures")
@with_json
@with_signing_settings()
async def cancel(settings: Settings, address: str, signatures: tuple[str, ...], refund: bool, as_json: bool) -> None:
    """Cancel the liability at ADDRESS: the promisee gets the cost back, and the promisor is not paid.

    Both parties must agree. The first party runs this command without --signature: it prints a signature and sends
    nothing. The other party runs it with that --signature, which ends the liability. Anyone else can end it with both
    signatures.

    If the promisor has disappeared, --refund returns the cost once the refund delay has passed. Anyone may do this;
    `aira liability show` prints the block from which it is possible.
    """
    if refund and signatures:
        raise click.UsageError("--refund and --signature can't be used together")
    async with open_signing_chain(settings) as chain:
        liability = await chain.liabilities.get(address)
        if liability.is_finalized:
            ended = f"{liability.address} has already ended: {OUTCOMES[liability.state]}"
            raise ChainError(ended, code="liability-ended")
        if refund:
            await _print_end(chain, await _refunded(chain, liability), liability, as_json)
        elif (settled := await _cancelled(chain, liability, signatures, as_json)) is not None:
            await _print_end(chain, settled, liability, as_json)


@command.command("stop", short_help="stop the job of one, as its customer or its robot")
@click.argument("address", type=ADDRESS)
@click.argument("why", default="")
@with_json
@with_settings(NetworkSettings, AccountSettings, ChainSettings)
async def stop(settings: Settings, address: str, why: str, as_json: bool) -> None:
    """Stop the job of the liability at ADDRESS, with the key of its promisee or its promisor. WHY becomes public with
    the recording.

    The robot's devices hear it, its handlers are cancelled, and the job ends with the code `stopped`, or
    `robot-stopped` if the promisor stops it. The cost comes back then; if the promisee stops it, that is what the
    description of the model says (`aira model show`).

    The exit code is 1 if the robot does not answer, or a device could not stop.
    """
    stopped = await _stopped(settings, address, why)
    _print_stopped(stopped, f"stopped {address}", as_json)


@command.command("hand-back", short_help="give the job of one back, as its robot")
@click.argument("address", type=ADDRESS)
@click.option("--code", default="handed-back", show_default=True, help="why, for programs: a word such as tool-broken")
@click.option("--why", default="", help="why, for people: at most 200 characters")
@with_json
@with_settings(NetworkSettings, AccountSettings, ChainSettings)
async def hand_back(settings: Settings, address: str, code: str, why: str, as_json: bool) -> None:
    """Hand back the job of the liability at ADDRESS, which the robot can't do, with the key of its promisor: the
    promisee gets the cost back, whatever the description of the model says. The code and the reason become public with
    the recording.

    A job that has begun is stopped. The robot goes on with the next one, also with `hold_when_stopped`.

    The exit code is 1 if the robot does not answer, or a device could not stop.
    """
    stopped = await _stopped(settings, address, why, code=code)
    _print_stopped(stopped, f"handed back {address}", as_json)


async def _stopped(settings: Settings, address: str, why: str, *, code: str | None = None) -> Stopped:
    from mesh.agent.contracts import request_stop
    from mesh.network import Endpoints, Network
    from mesh.role.composition import load_account

    account = await asyncio.to_thread(load_account, settings)
    async with open_chain(settings) as chain, Network(Endpoints.from_settings(settings)) as network:
        liability = await chain.liabilities.get(address)
        return await request_stop(network.session, account.signer, liability, why, code=code)


def _print_stopped(stopped: Stopped, done: str, as_json: bool) -> None:
    """Print that it is `done`. Raises `RemoteError` if a device did not hear it."""
    if as_json:
        print_json(stopped)
    else:
        print_line(done)
        for line in device_lines(stopped):
            print_line(line)
    if missed := [one.device for one in stopped.devices if not one.heard]:
        who = ", ".join(map(printable, missed))
        raise RemoteError(f"not stopped: {who}", hint="tell who is beside it to cut its power", code="not-stopped")


def device_lines(stopped: Stopped) -> list[str]:
    """What the robot's devices say of a stop, for people."""
    return [
        f"  {printable(one.device)} has {'heard it' if one.heard else f'not heard it: {printable(one.detail)}'}"
        for one in stopped.devices
    ]


async def _refunded(chain: Chain, liability: Liability) -> Settled:
    state = await chain.liabilities.refund_state(liability.address)
    if not state.is_refundable:
        raise ChainError(
            f"{liability.address} can't be refunded yet: {refund_words(state)}",
            hint="until then both parties can cancel it: `aira liability cancel` without --refund",
            code="not-refundable",
        )
    with notice_when_slow():
        return await chain.liabilities.refund(liability.address)


async def _cancelled(chain: Chain, liability: Liability, signatures: Sequence[str], as_json: bool) -> Settled | None:
    """The end, mined; None if the other party has to sign first, which is printed. Raises `ChainError`."""
    signed = _signed(chain, liability, signatures)
    missing = [party for party in ("promisee", "promisor") if party not in signed]
    if not missing:
        parties = {f"{party}_signature": signature for party, signature in signed.items()}
        with notice_when_slow():
            return await chain.liabilities.cancel(liability.address, **parties)
    if not signed:
        raise ChainError(
            f"the account is neither promisee nor promisor of {liability.address}",
            hint="give the signatures of both parties, or the keyfile of one of them",
            code="not-a-party",
        )
    if signatures:
        raise ChainError(
            f"the signature of the {missing[0]} is missing",
            hint="the other party prints it with `aira liability cancel`",
            code="signature-missing",
        )
    _print_signature(chain, liability, signed, as_json)
    return None


def _signed(chain: Chain, liability: Liability, signatures: Sequence[str]) -> dict[str, str]:
    """Party → signature (0x…): the given signatures, and that of the own account if it is a party."""
    from schemas import cancellation_hash, recover

    assert chain.account is not None
    digest = cancellation_hash(liability.address)
    own = "0x" + chain.account.signer.sign_hash(digest).hex()
    parties = {"promisee": liability.promisee, "promisor": liability.promisor}
    signed = {party: own for party, address in parties.items() if address == chain.account.address}
    for signature in signatures:
        try:
            signer = recover(digest, signature)
        except InvalidMessage as error:
            raise InputError(
                f"invalid signature: {error.detail}",
                hint="a signature is 0x and 130 hexadecimal digits",
                code="invalid-signature",
            ) from None
        found = {party: signature for party, address in parties.items() if address == signer}
        if not found:
            raise InputError(
                f"the signature is by {signer}, or for another liability",
                hint=f"the signer must be {liability.promisee} or {liability.promisor}",
                code="invalid-signature",
            )
        signed |= found
    return signed


def _print_signature(chain: Chain, liability: Liability, signed: dict[str, str], as_json: bool) -> None:
    assert chain.account is not None
    party, signature = next(iter(signed.items()))
    other = "promisor" if party == "promisee" else "promisee"
    whose = getattr(liability, other)
    if as_json:
        facts = {"liability": liability.address, "signer": chain.account.address, "party": party}
        print_json(facts | {"signature": signature, "needed": whose})
        return
    print_line(f"as the {party}, you agree to cancel {liability.address} with this signature:\n\n{signature}\n")
    print_line(f"Nothing was sent. The {other}, {whose}, can end it with:\n")
    print_line(f"aira liability cancel {liability.address} --signature {signature}")


async def _print_end(chain: Chain, settled: Settled, before: Liability, as_json: bool) -> None:
    liability = await chain.liabilities.get(before.address)
    owed = await chain.liabilities.owed_after(liability)
    unit = (await units_of(chain, [liability]))[liability.token]
    paid = {"paid back": f"{unit.show(liability.cost)}  to {liability.promisee}"}
    facts = {"liability": liability.address, "state": OUTCOMES[liability.state]}
    facts |= {"owed": owed_words(liability, unit, owed)} if owed else paid
    result = liability_json(liability) | {"tx": settled.tx, "gasUsed": settled.gas_used}
    result |= {"owed": str(owed)} if owed else {}
    print_result(result, facts | {"transaction": settled.tx}, as_json=as_json)


@command.command("claim", short_help="take what the token refused to pay at the end of one")
@click.argument("address", type=ADDRESS)
@click.option("--to", type=ADDRESS, help="another account that receives it; only for the account that is owed it")
@with_json
@with_signing_settings()
async def claim(settings: Settings, *, address: str, to: str | None, as_json: bool) -> None:
    """Pay what is owed after the liability at ADDRESS, because its token refused to pay it when the liability ended.

    `aira liability show` says whether something is owed. Anyone can claim it for the account that it is owed to. All
    that this account is owed in the token is paid, of other liabilities, too.

    If the token still refuses the account, its owner can have it paid to another one with --to.
    """
    async with open_signing_chain(settings) as chain:
        liability = await chain.liabilities.get(address)
        account, owed = cost_receiver(liability), await chain.liabilities.owed_after(liability)
        if not owed:
            why = "was paid" if liability.is_finalized else "has not ended"
            raise ChainError(f"nothing is owed: {liability.address} {why}", code="nothing-owed")
        receipt = await _claimed(chain, liability, account, to)
        receiver = account if to is None else await chain.names.address(to)
        unit = (await units_of(chain, [liability]))[liability.token]
        result: dict[str, Any] = {
            "liability": liability.address,
            "token": liability.token,
            "account": account,
            "to": receiver,
        }
        result |= {"claimed": str(owed), "tx": receipt.tx, "gasUsed": receipt.gas_used}
        facts = {"claimed": f"{unit.show(owed)}  to {receiver}", "transaction": receipt.tx}
        print_result(result, facts, as_json=as_json)


async def _claimed(chain: Chain, liability: Liability, account: str, to: str | None) -> Receipt:
    """The claim, mined. Raises `ChainError`."""
    assert chain.account is not None
    if to is not None and chain.account.address != account:
        raise ChainError(
            f"only {account} can have what it is owed paid to another account",
            hint="without --to anyone can claim it for that account",
            code="not-a-party",
        )
    try:
        with notice_when_slow():
            return await chain.liabilities.claim(liability.token, account, to=to)
    except Reverted as error:
        raise ChainError(
            f"the token {liability.token} still refuses to pay {account if to is None else to}"
            + (f": {error.reason}" if error.reason else ""),
            hint="the account that is owed it can have it paid to another one with --to",
            code="claim-refused",
        ) from error


@command.command("watch", short_help="follow one until it ends, or all of them")
@click.argument("address", required=False, type=ADDRESS)
@click.option(
    "--from-block", type=click.IntRange(min=0), help="without ADDRESS: the first block to read [the next one]"
)
@with_json
@with_chain_settings(NetworkSettings, "lighthouse_contract", "confirmations", "finality", "poll_interval")
async def watch(settings: Settings, address: str | None, from_block: int | None, as_json: bool) -> None:
    """Wait until the liability at ADDRESS has ended, then show it. If the node is unreachable, wait for it. If it names
    a validator, print how its jurors judge when they do.

    Without ADDRESS, print each liability when it is created and when it ends, until Ctrl-C; with --json one object per
    line.
    """
    if address is None:
        await _watch_all(settings, from_block, as_json)
        return
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        liability = await chain.liabilities.get(address)
        async with Background() as tasks:
            if not liability.is_finalized and not as_json:
                print_line(f"{liability.address} is open; waiting until it ends (Ctrl-C stops waiting)")
                tasks.start(print_verdicts(settings, chain, liability), "verdicts")
            ended = await chain.liabilities.watch(address)
        await print_liability(chain, ended, settings, own=own, as_json=as_json)


async def _watch_all(settings: Settings, from_block: int | None, as_json: bool) -> None:
    own = await asyncio.to_thread(own_address, settings)
    async with open_chain(settings) as chain:
        cursor = await chain.block_number() + 1 if from_block is None else from_block
        if not as_json:
            click.echo(f"watching from block {cursor:,}; Ctrl-C stops it", err=True)
        outages = _PrintedOutages()
        async with aclosing(chain.follow(cursor, outages=outages)) as blocks:
            async for block in blocks:
                events = await chain.retrying(partial(_liability_events, chain, block, own), outages=outages)
                for facts, line in events:
                    if as_json:
                        print_json(facts)
                    else:
                        print_line(line)


class _PrintedOutages(OutageLog):
    """Prints to stderr that the node is unreachable, once per outage."""

    def __init__(self) -> None:
        super().__init__(log, "chain")
        self._has_failed = False

    def failed(self, error: AiraError, consequence: str) -> None:
        """Print `error`, unless the outage is already known."""
        if not self._has_failed:
            click.echo(f"aira: {error}; waiting for it", err=True)
        self._has_failed = True

    def recovered(self, message: str) -> None:
        """The next failure is another outage."""
        self._has_failed = False


async def _liability_events(chain: Chain, block: BlockEvents, own: str | None) -> list[tuple[dict[str, Any], str]]:
    """The creations and ends of liabilities in a block or a reorganisation, in order: each for JSON and for people."""
    from mesh.chain import Finalized, NewLiability, NoContracts, Reorganisation

    found: list[tuple[dict[str, Any], str]] = []
    for event in block.reverted_events if isinstance(block, Reorganisation) else ():
        if isinstance(event, NewLiability | Finalized):
            word, what = ("made", "creation") if isinstance(event, NewLiability) else ("ended", "end")
            facts: dict[str, Any] = {"event": "taken-back", "what": word, "liability": event.liability, "tx": event.tx}
            found.append((facts, f"a reorganisation reverted the {what} of {event.liability}"))
    for event in block.events:
        if not isinstance(event, NewLiability | Finalized):
            continue
        try:
            liability = await chain.liabilities.get(event.liability)
        except NoContracts:  # reverted meanwhile: the reorganisation comes next
            continue
        is_new, number = isinstance(event, NewLiability), block.block_number
        facts = {"event": "made" if is_new else "ended", "blockNumber": number, "tx": event.tx}
        word = "created" if is_new else liability.state
        parties = f"{short_address(liability.promisor, own=own)} for {short_address(liability.promisee, own=own)}"
        cost = (await units_of(chain, [liability]))[liability.token].show(liability.cost)
        line = f"block {number:,}  {liability.address}  {word:<10}  {parties}, {cost}"
        found.append((facts | {"liability": liability_json(liability)}, line))
    return found
