"""`aira demand`: publishes a demand and waits until its liability has ended.

Before it signs it says who judges, and what it does if an equal demand of the account is open or has become a contract:
the same job, at a price that this command could pay, and not for another robot than the one that is named.
While it waits it prints the progress of the demand and its job, and losses of the router.
"""

from __future__ import annotations

import asyncio
import shutil
import signal
import sys
from collections import Counter
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import click

from mesh.agent.orders import OrderExpired
from mesh.amounts import XRT
from mesh.base.background import Background, in_daemon_thread
from mesh.chain import permit_fee as permit_fee_of
from mesh.cli.chain_client import check_balance
from mesh.cli.files import NamedModel, model_named, objective_given, objective_of, require_writable
from mesh.cli.liability import device_lines
from mesh.cli.options import (
    ADDRESS,
    PATH,
    SECONDS,
    AmountText,
    TokenAmountText,
    with_json,
    with_objective,
    with_settings,
)
from mesh.cli.order import withdraw_orders, withdrawal_lines
from mesh.cli.output import format_duration, plural, print_json, print_line, printable, progress, wait_for_broken_pipe
from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from mesh.watching.robots import RobotDirectory, labelled, robot_address
from schemas import Demand
from schemas.address import ZERO_ADDRESS
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from mesh import AnnouncedValidator
    from mesh.agent.agent import Agent, Messages
    from mesh.agent.contracts import Contract, Outcome, Progress
    from mesh.agent.trade import Order
    from mesh.agent.validators import ValidatorDirectory
    from mesh.amounts import Unit
    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.recording import Objective
    from mesh.settings import Settings


A = TypeVar("A")

STEP: Final = 10
"""Percent of a playback after which another line is printed where there is no bar."""
BEHIND: Final = 32
"""Blocks that the agent has yet to read, above which the command says so."""


class DemandPace(NamedTuple):
    """How long the command waits, in seconds."""

    holder: float = 3.0
    """Until somebody on the mesh says that it has the objective."""
    stop_prompt: float = 5.0
    """For another Ctrl-C, which stops the robot."""
    validity: float = 1.0
    """For the node, when interrupted, to say for how long the demand stays valid."""
    silence: float = 5.0
    """For an offer or a decline, until it says who is present."""


DEMAND_PACE: Final = DemandPace()
CHOICES: Final = {
    "wait": "wait for it",
    "withdraw": "withdraw it, and post a new one",
    "new": "post another one beside it",
}


async def take_existing(
    agent: Agent,
    objective: str,
    existing: str | None,
    *,
    printer: JobPrinter,
    validator: str,
    payable: range,
    token: str,
    robot: str,
) -> Order | Contract | None:
    """What to wait for instead of a new demand: the open one for the same job, or its contract. None: post a new one.

    `payable` are the costs that a new one may have in `token`, `robot` is the one that it names (addresses), if any.
    `existing` is the choice; without one, the user is asked. Raises `ConfigurationError` without a terminal.
    """
    find = partial(_equal, agent, objective, validator=validator, payable=payable, token=token, robot=robot)
    demands, contract = await find()
    if demands:  # perhaps one became a contract while nothing of the account ran
        await agent.parts.chain_head.reached(await agent.parts.chain.block_number())
        demands, contract = await find()
    if others := len(agent.orders()) - len(demands):
        click.echo(f"this account also has {plural(others, 'other open order')}; see `aira order list`", err=True)
    if not demands and contract is None:
        return None
    for robot in {one.robot for one in (*demands, *([contract] if contract else ())) if one.robot}:
        await agent.parts.robots.find(robot)  # to show its name
    for order in demands:
        terms = printer.terms(order.message.cost, order.robot)
        click.echo(f"the equal demand {order.hash}, {terms}, is open until block {order.deadline:,}", err=True)
    if contract is not None:
        terms = printer.terms(contract.liability.cost, contract.robot)
        click.echo(f"an equal demand became the contract {contract.address}, {terms}, which has not ended", err=True)
    if existing is None and (printer.as_json or not sys.stdin.isatty()):
        choices = ", ".join(f"--existing {choice} ({meaning})" for choice, meaning in CHOICES.items())
        raise ConfigurationError(
            "an equal demand is open; a second one would be paid too", hint=f"choose: {choices}", code="demand-exists"
        )
    choice = existing
    if choice is None:
        click.echo("\n".join(f"  {word}: {meaning}" for word, meaning in CHOICES.items()), err=True)
        choice = await answer_of(partial(click.prompt, "what now?", type=click.Choice(list(CHOICES)), err=True))
    if choice == "wait":
        return contract or demands[0]
    for order in demands if choice == "withdraw" else ():
        await order.withdraw()
        click.echo(f"withdrew {order.hash}; a provider that is creating its contract now may still finish", err=True)
    return None


async def _equal(
    agent: Agent, objective: str, *, validator: str, payable: range, token: str, robot: str
) -> tuple[list[Order], Contract | None]:
    """The open demands that are equal, and the latest contract of one that has not ended, of the latest eight."""
    from mesh.agent.orders import is_repeated
    from schemas import Demand, decode

    fields: dict[str, Any] = {"model": agent.model, "objective": objective, "validator": validator}
    wanted = await agent.runtime.trader.writer.terms(**fields, cost=payable.start, token=token, lifetime=1)

    def is_equal(message: object) -> bool:
        return isinstance(message, Demand) and is_repeated(message, wanted, payable=payable)

    def may_do_it(who: str) -> bool:
        return not robot or who in ("", robot)

    demands = [order for order in agent.orders() if is_equal(order.message) and may_do_it(order.robot)]
    contracts = await agent.parts.ledger.contracts("demand")
    liabilities = agent.parts.chain.liabilities
    for address in [address for payload, address in contracts if is_equal(decode(payload))][:8]:
        if await liabilities.exists(address):
            liability = await liabilities.get(address)
            if not liability.is_finalized and may_do_it(liability.promisor):
                return demands, await agent.contract(address)
    return demands, None


class JobPrinter:
    """Prints what happens to a demand and its job: lines, and a bar on a terminal; or, `as_json`, an object for each.

    `unit` is that of the demand's token, and `name_of` says what the robot at an address calls itself. Use it as
    `on_progress`, and `close` it at the end.
    """

    def __init__(self, unit: Unit, *, as_json: bool, name_of: Callable[[str], str] = lambda _address: "") -> None:
        self._unit = unit
        self._name_of = name_of
        self.as_json = as_json
        self.awaited = "the payment"
        """What follows the robot's result."""
        self.number = ""
        """That of the job, if it has several attempts."""
        self.on_stop = ""
        """What becomes of the cost if the job is stopped, `refund` or `paid`; empty if it is not known."""
        self._bar = ExitStack()
        self._move: Callable[[int, int | None], None] | None = None
        self._percent = -STEP
        self.has_contract = False
        """Whether there is a contract that has not ended."""
        self._offers: set[str] = set()
        self._declines: dict[str, str] = {}

    def __call__(self, seen: Progress) -> None:
        """Print what happened. What can't be printed because the reader has gone is lost."""
        with suppress(BrokenPipeError):  # `wait_for_broken_pipe` ends the command
            self._print(seen)

    def _print(self, seen: Progress) -> None:
        if seen.kind == "offer" and not seen.code:
            self._offers.add(seen.agent)
        if seen.kind == "declined":
            self._declines[seen.agent] = seen.code
        if seen.kind in ("contract", "paid", "refunded"):
            self.has_contract, self._percent = seen.kind == "contract", -STEP
        if self.as_json:
            print_json(_json(seen, self._name_of(seen.agent)))
        elif seen.kind == "playing":
            self._playing(seen)
        elif words := self._words(seen):
            self.close()
            print_line(words)

    def line(self, text: str, **facts: Any) -> None:
        """Print a line for people or, as JSON, its facts, if it has any."""
        if not self.as_json:
            print_line(text)
        elif facts:
            print_json(facts)

    def terms(self, cost: int, robot: str) -> str:
        """What is paid, and to which robot (address; empty for any), for people."""
        return f"{self._unit.show(cost)} for {labelled(robot, self._name_of(robot)) if robot else 'any robot'}"

    def posted(self, order: Order) -> None:
        """Print an order for the job."""
        facts: dict[str, Any] = {"order": order.hash, "cost": str(order.message.cost), "robot": order.robot}
        facts |= {"name": name} if (name := self._name_of(order.robot)) else {}
        facts |= {"number": self.number} if self.number else {}
        words = f"{self.terms(order.message.cost, order.robot)}, valid until block {order.deadline:,}"
        if isinstance(order.message, Demand) and (fee := permit_fee_of(order.message)):
            facts["permitFee"] = str(fee)
            words += f"; {self._unit.show(fee)} more to the provider with the permit"
        self.line(f"posted {order.hash}, {words}", kind="posted", **facts, deadline=order.deadline)

    @property
    def stop_cost(self) -> str:
        """What becomes of the cost if the job is stopped, for people."""
        return "the robot is paid all the same" if self.on_stop == "paid" else "the cost comes back"

    def close(self) -> None:
        """End the bar."""
        self._bar.close()
        self._move = None

    @property
    def is_silent(self) -> bool:
        """Whether no robot has offered or declined."""
        return not self._offers and not self._declines

    def summary(self) -> str:
        """How many robots offered and declined, with the declines' codes."""
        reasons = ", ".join(f"{count} {code}" for code, count in Counter(self._declines.values()).most_common())
        declines = f"{plural(len(self._declines), 'robot')} declined" + (f" ({reasons})" if reasons else "")
        return f"{plural(len(self._offers), 'robot')} offered, {declines}"

    def _words(self, seen: Progress) -> str:
        who = labelled(seen.agent, self._name_of(seen.agent))
        why = f"{printable(seen.detail)} ({printable(seen.code)})".lstrip()
        match seen.kind:
            case "offer":
                return f"offer by {who}{self._difference(seen)}"
            case "declined":
                return f"declined by {who}: {why}"
            case "rejected":
                return f"provider {who} can't use the demand now: {why}"
            case "contract":
                return f"contract {seen.detail} with {who}"
            case "ready":
                return "the robot is ready"
            case "gone" if seen.code == "unseen":
                return (
                    f"robot {who} can't be watched from here: it is on the legacy network and works there, or it is "
                    "off; the contract holds the cost while it waits for it"
                )
            case "gone":
                return f"robot {who} is gone; the contract holds the cost while it waits for it"
            case "back":
                return f"robot {who} is back"
            case "late":
                return f"robot {who} has not begun within {seen.detail} s; stopping it"
            case "again":
                attempt = f"attempt {seen.position} of {seen.total}"
                return f"job {self.number}: {who} did not do it: {why}; ordering again, {attempt}"
            case "given-up":
                return f"job {self.number}: not ordered again: {why}"
            case "result" if seen.code:
                return "the robot has given up; waiting for the chain to return the cost"
            case "result":
                return f"the robot is done; waiting for {self.awaited}"
            case "judged":
                votes = f", {seen.position} of {seen.total} needed" if seen.total > 1 else ""
                return f"juror {who} judged{votes}: {printable(seen.detail)}"
            case "unjudged" if seen.code == "disagree":
                return f"the jurors of {who} disagree: {seen.detail}"
            case "unjudged":
                return f"the validator {who} is silent: {seen.detail}"
        return ""

    def _difference(self, offer: Progress) -> str:
        if not offer.code:
            return ""
        wants = self._unit.show(int(offer.detail)) if offer.code == "other-cost" else printable(offer.detail)
        return f" for other terms: {offer.code.removeprefix('other-')} {wants}"

    def _playing(self, seen: Progress) -> None:
        percent = 100 * seen.position // max(seen.total, 1)
        if sys.stderr.isatty():
            if self._move is None:
                self._move = self._bar.enter_context(progress("playing"))
            self._move(seen.position, seen.total)
        elif percent // STEP != self._percent // STEP:
            self._percent = percent
            print_line(f"playing: {percent} %, {seen.position:,} of {plural(seen.total, 'message')}")


def _json(seen: Progress, name: str) -> dict[str, Any]:
    facts: dict[str, Any] = {"kind": seen.kind, "agent": seen.agent} | ({"name": name} if name else {})
    if seen.kind == "playing":
        return facts | {"position": seen.position, "total": seen.total}
    if seen.kind in ("judged", "unjudged"):
        facts |= {"votes": seen.position, "needed": seen.total}
    if seen.kind == "again":
        facts |= {"attempt": seen.position, "attempts": seen.total}
    return facts | {"code": seen.code, "detail": seen.detail}


async def answer_of(ask: Callable[[], A]) -> A:
    """What `ask` returns, which asks in the terminal, in a thread that does not keep an interrupted program alive."""
    return await asyncio.wrap_future(in_daemon_thread(ask, "prompt"))


async def print_connection_changes(network: Network, *, before: Callable[[], object] = lambda: None) -> None:
    """Print to stderr when the router is unreachable, and when it is back, until cancelled; call `before` that."""
    async for _ in network.changes():
        before()
        words = "connected to the router again" if network.connected else "lost the router; waiting for it"
        click.echo(f"aira: {words}", err=True)


@dataclass(frozen=True, kw_only=True)
class JudgedTerms:
    """What a validator announces, the fee that the demand offers, and when the cost can be returned without it."""

    announced: AnnouncedValidator
    fee: int
    refund_delay: int | None
    """Blocks from the contract's creation; None if the contracts offer no refund."""
    block_time: float | None
    """Seconds."""

    @classmethod
    async def of(
        cls,
        chain: Chain,
        directory: ValidatorDirectory,
        validator: str,
        *,
        lighthouse: str,
        generation: int,
        fee: int | None,
    ) -> JudgedTerms:
        """Those of a demand at `lighthouse` that names `validator` (addresses); without a `fee` (wn) what it announces.

        Raises `UnsafeValidator` and its like, `ChainError`.
        """
        from mesh.agent.orders import ORDER_LIFETIME
        from mesh.agent.validators import check_named, refund_delay

        await check_named(chain, validator, lighthouse=lighthouse, generation=generation)
        announced, block_time = await directory.find(validator), None
        with suppress(AiraError):  # then it is not known
            block_time = await chain.node.contract_blocks.seconds(ORDER_LIFETIME.measured)
        return cls(
            announced=announced,
            fee=announced.fee if fee is None else fee,
            refund_delay=await refund_delay(chain),
            block_time=block_time,
        )

    @property
    def doubts(self) -> dict[str, str]:
        """Why perhaps nobody will judge, by code."""
        announced, doubts = self.announced, {}
        if announced.is_silent:
            doubts["silent"] = "nobody answers as this validator on the mesh, so perhaps nobody will judge"
        elif not announced.has_quorum:
            online = len(announced.announcements)
            doubts["few-jurors"] = f"only {online} of the {announced.quorum} jurors that must judge alike answer"
        if self.fee < announced.fee:
            offered = f"the fee is {XRT.show(self.fee)}, but the validator wants {XRT.show(announced.fee)}"
            doubts["low-fee"] = f"{offered}, so it may refuse the work"
        return doubts

    @property
    def reasons(self) -> str:
        """The doubts, for people."""
        return "; ".join(self.doubts.values())

    def lines(self) -> Iterator[str]:
        """What it means, for people."""
        found = self.announced
        title = f"{printable(found.title)}, " if found.title else ""
        yield f"validator {title}{found.address}"
        if not found.is_silent:
            online = f"{len(found.announcements)} of its {found.jurors} jurors are on the mesh"
            judges = "it is on the mesh" if found.jurors == 1 else f"{online}, {found.quorum} must judge alike"
            yield f"  {judges}; nobody is paid for the work before it has judged"
            for policy in found.policies:
                yield f"  judges by {policy.name}: {printable(policy.description)}"
            if not found.is_unanimous:
                yield "  its jurors judge by different policies"
        low = " (what it wants is not known)" if found.is_silent else ""
        yield f"  fee {XRT.show(self.fee)}{low}, on top of the cost, also if the work does not count"
        yield f"  if it is silent: {self.refund}"

    @property
    def refund(self) -> str:
        """What can be returned, and when, if nobody judges."""
        if self.refund_delay is None:
            return "the contracts offer no refund, so the cost stays in the contract"
        about = f" (about {_rough(self.refund_delay * self.block_time)})" if self.block_time else ""
        return (
            f"cost and fee can be refunded {plural(self.refund_delay, 'block')}{about} after the contract was created"
        )

    def json(self) -> dict[str, Any]:
        """The same for JSON; fees in wn."""
        found = self.announced
        return {
            "validator": found.address,
            "title": found.title,
            "jurors": found.jurors,
            "quorum": found.quorum,
            "online": [one.juror for one in found.announcements],
            "policies": [{"name": policy.name, "description": policy.description} for policy in found.policies],
            "unanimous": found.is_unanimous,
            "announcedFee": None if found.is_silent else str(found.fee),
            "fee": str(self.fee),
            "refundDelay": self.refund_delay,
            "blockTime": self.block_time,
            "doubts": self.doubts,
        }


def _rough(seconds: float) -> str:
    """A time for people, in minutes, hours or days."""
    for unit, length in (("day", 86_400), ("hour", 3600)):
        if seconds >= 2 * length:
            return plural(round(seconds / length), unit)
    return plural(max(round(seconds / 60), 1), "minute")


async def agreed_fee(
    agent: Agent, cid: str, fee: int | None, *, confirmed: bool, as_json: bool, validator: str, **fields: Any
) -> int:
    """The validator's fee for a demand of the objective `cid`, in wn, once its maker knows what the validator means.

    `fee` is what the maker offers, None for what is announced. Doubts whether somebody will judge must be `confirmed`,
    or are asked about in a terminal. Raises `UnsafeValidator` and its like, and `RemoteError`.
    """
    if not validator:
        return 0
    runtime = agent.runtime
    terms = await runtime.trader.writer.terms(model=agent.model, objective=cid, validator=validator, **fields)
    if terms["validator"] == ZERO_ADDRESS:
        return 0
    judged = await JudgedTerms.of(
        agent.parts.chain,
        runtime.validators,
        terms["validator"],
        lighthouse=terms["lighthouse"],
        generation=agent.settings.generation,
        fee=fee,
    )
    if as_json:
        print_json({"kind": "validator"} | judged.json())
    else:
        for line in judged.lines():
            print_line(line)
    if judged.doubts:
        can_ask = sys.stdin.isatty() and not as_json
        if confirmed or can_ask:
            click.echo(f"aira: {judged.reasons}", err=True)
        ask = partial(click.confirm, "post the demand all the same?", err=True)
        if not (confirmed or (can_ask and await answer_of(ask))):
            hint = "`--yes` posts the demand all the same"
            raise RemoteError(f"not posted: {judged.reasons}", hint=hint, code="validator-doubtful")
    return judged.fee


@click.command("demand")
@click.option(
    "--model", help="model, the behaviour that you order: its file, CID or ENS name [that of --robot NAME|ADDRESS]"
)
@with_objective
@click.option(
    "--cost",
    type=TokenAmountText(),
    default="0",
    show_default=True,
    help="what you pay: whole tokens (1.5, 3.50 USDC, 3.50 0x…), or the smallest unit (1500000000wn, 15units)",
)
@click.option(
    "--robot", default="", help="the only robot that gets the job: name, address, cheapest or first (done first) [any]"
)
@click.option(
    "--max-cost",
    type=TokenAmountText(),
    help="raise --cost up to this if robots want more; the most for a chosen robot",
)
@click.option(
    "--retry",
    type=click.IntRange(0, 10),
    default=0,
    show_default=True,
    help="how often a job that fails is ordered again, from another robot, when its cost is back",
)
@click.option(
    "--start-within",
    type=SECONDS,
    metavar="SECONDS",
    help="stop a robot that does not begin so many seconds after the contract; the job has failed then [wait]",
)
@click.option("--validator", type=ADDRESS, default="", help="address or ENS name of the validator of the result [none]")
@click.option(
    "--validator-fee", type=AmountText(), help="the validator's fee, in XRT (or wn) [what the validator announces]"
)
@click.option(
    "--permit-fee",
    type=TokenAmountText(),
    help="what the provider gets for creating the contract with a permit of yours, in the token of --cost; a provider "
    "that wants more says how much [nothing]",
)
@click.option(
    "--lifetime", type=click.IntRange(min=1), help="number of blocks for which the demand is valid [about ten minutes]"
)
@click.option(
    "--existing",
    type=click.Choice(list(CHOICES)),
    help="what to do if an equal demand is open: wait for it, withdraw it first, or post another [ask]",
)
@click.option(
    "--wait", is_flag=True, help="wait for other robots if all that are present have declined [withdraw the demand]"
)
@click.option("--yes", "confirmed", is_flag=True, help="post the demand even if perhaps nobody judges the work")
@click.option("--out", type=PATH, help="file to copy the recording to")
@click.option(
    "--withdraw-on-exit", is_flag=True, help="withdraw the demand if the command is interrupted before the contract"
)
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", "erc20_token", AccountSettings, ChainSettings)
async def demand(
    settings: Settings,
    *,
    model: str | None = None,
    objective: str | None = None,
    messages: Messages = (),
    validator_fee: str | None,
    permit_fee: str | None = None,
    out: Path | None,
    as_json: bool,
    confirmed: bool = False,
    robot: str = "",
    max_cost: str | None = None,
    retry: int = 0,
    start_within: float | None = None,
    wait: bool = False,
    existing: str | None = None,
    withdraw_on_exit: bool = False,
    **terms: Any,
) -> None:
    """Publish a demand and wait for the contract, the work and the payment. The objective is checked first, as `aira
    objective check` does. What happens is printed as it happens: offers, robots that decline and why, the contract, the
    playback, the result. The recording is kept in the account's store, so that `aira verify` and `aira objective show`
    need no robot.

    If all robots of the model that are present decline, the demand is withdrawn and the command ends with their
    reasons; --wait keeps it open. With --robot only that robot gets the job. It is asked first, and if it declines
    the command ends with its reason.

    With --retry a job that fails is ordered again from the cheapest of the other robots (or the first), up to the same
    price, before the first demand's deadline. All attempts have one number, which is printed. A job that you stop is
    not ordered again. The command does that: if it ends, the contract goes on, and no attempt follows.

    Ctrl-C stops waiting, but does not withdraw the demand (--withdraw-on-exit or `aira order withdraw` does) or cancel
    the contract. In a terminal a second Ctrl-C, within five seconds, stops the robot, as `aira liability stop` does.
    A demand that was interrupted stays open until its deadline. If an equal one is open, the command asks
    what to do; without a terminal it needs --existing.

    With --validator, the command first says who judges the work and by which policies, what that costs, and what
    happens if nobody judges. If nobody answers as the validator, or wants a higher fee, it asks; without a terminal it
    needs --yes.

    The exit code is 1 if the work was not done and the cost was returned, or if --out can't be written. --json prints
    an object for each thing that happens, with its `kind`, and one when the contract has ended; that has an `error` if
    the exit code is 1.
    """
    from mesh.agent.agent import CHOICES as BY_QUOTE
    from mesh.agent.agent import Agent

    if model is None and robot in ("", *BY_QUOTE):
        raise InputError(
            "give --model, or --robot with a name or an address",
            hint="`aira robots` lists the robots; `aira robots NAME` shows what one does",
            code="invalid-options",
        )
    named_model = None if model is None else await asyncio.to_thread(model_named, model)
    source = await asyncio.to_thread(objective_given, objective, messages)
    settings.keyfile_and_password()
    fee = None if validator_fee is None else XRT.parse(validator_fee)
    if fee and not terms["validator"]:
        raise InputError(
            "--validator-fee needs --validator", hint="give --validator, or omit the fee", code="invalid-options"
        )
    if permit_fee and terms["validator"]:
        raise InputError(
            "--permit-fee can't be used with --validator",
            hint="omit one of them: a demand has one fee, which is the validator's if it has one",
            code="invalid-options",
        )
    if out is not None:
        await asyncio.to_thread(require_writable, out)
    named_model = named_model or await _model_of(settings, robot)
    checked = await asyncio.to_thread(_check_objective, settings, source) if isinstance(source, Path) else None
    # A server with the same settings may run beside this and serve metrics at the same port.
    async with Agent(named_model.name, settings=replace(settings, metrics_listen="")) as agent, Background() as tasks:
        given = [permit_fee or 0, terms["cost"], *([] if max_cost is None else [max_cost])]
        token, unit, amounts = await agent.parts.chain.tokens.amounts(*given, default=agent.settings.erc20_token)
        for_permit, cost, most = amounts[0], amounts[1], amounts[-1]
        terms |= {"token": token, "cost": cost}
        with closing(JobPrinter(unit, as_json=as_json, name_of=agent.parts.robots.name)) as printer:
            changes = print_connection_changes(agent.parts.network, before=printer.close)
            tasks.start(changes, "network losses")
            tasks.start(wait_for_broken_pipe(), "readers of stdout")
            tasks.start(_say_how_far_it_read(agent), "catching up")
            printer.line(f"demand by {agent.address} for {agent.model}")
            if named_model.file is not None:  # for robots and pages that read its description
                await agent.add(named_model.file)
            cid = await objective_of(agent, source)
            if most < cost:
                raise InputError("--max-cost is less than --cost", hint="omit one of them", code="invalid-options")
            named = await _address_of(agent, robot) if robot and robot not in BY_QUOTE else ""
            terms["validator_fee"] = await agreed_fee(agent, cid, fee, confirmed=confirmed, as_json=as_json, **terms)
            printer.awaited = "the validator" if terms["validator"] else printer.awaited
            printer.on_stop = await _on_stop(agent)
            payable = range(0 if robot in BY_QUOTE else cost, most + 1)
            order = await take_existing(
                agent,
                cid,
                existing,
                printer=printer,
                validator=terms["validator"],
                payable=payable,
                token=token,
                robot=named,
            )
            if order is None:
                await check_balance(agent.parts.chain, unit, most + for_permit, token=token)
                terms |= {
                    "permit_fee": for_permit,
                    "robot": named or robot,
                    "max_cost": None if max_cost is None else most,
                }
                order = await _post(agent, cid, checked, printer, retry=retry, start_within=start_within, **terms)
            elif retry or start_within is not None:
                click.echo("aira: --retry and --start-within are only for new demands", err=True)
            contract = await _contract(agent, order, printer, withdraw_on_exit=withdraw_on_exit, wait=wait)
            await _wait_for_end(agent, contract, printer, out, withdraw_on_exit=withdraw_on_exit)


async def _model_of(settings: Settings, robot: str) -> NamedModel:
    """The model of a robot, by its name or address. Raises as `RobotDirectory.named`."""
    from mesh.role.composition import watching

    async with watching(settings) as (network, channel):
        found = await RobotDirectory(network.session, channel).named(robot)
    if not found.model:
        raise InputError(
            f"{labelled(found.address, found.name)} names no model", hint="give --model", code="robot-unknown"
        )
    return NamedModel(found.model)


def _check_objective(settings: Settings, path: Path) -> Objective:
    """Check a file as robots do. Raises `ObjectiveUnfit`."""
    from mesh.agent.objectives import ObjectiveUnfit
    from mesh.recording import Limits, preflight

    with progress(f"checking {path.name}") as tell:
        outcome = preflight(path, Limits.of(settings), progress=tell)
    if outcome.objective is None or not outcome.ok:
        raise ObjectiveUnfit(str(path), outcome.reason, printable(outcome.detail))
    return outcome.objective


async def _check_held(agent: Agent, cid: str) -> Objective | None:
    """Check the objective with a CID, if it is in the store or somebody has it; else warn. Raises `ObjectiveUnfit`."""
    parts = agent.parts
    held = await asyncio.to_thread(parts.store.checked, cid)
    if held or await parts.exchange.is_held(cid, timeout=DEMAND_PACE.holder):
        return await agent.examine(cid)
    warning = f"nobody here has the objective {cid}: no robot can offer before somebody serves it"
    click.echo(f"aira: {warning}; `aira objective add FILE` prints a file's CID", err=True)
    return None


async def _post(
    agent: Agent, cid: str, checked: Objective | None, printer: JobPrinter, *, retry: int, **terms: Any
) -> Order:
    """Publish the demand; first check its objective, unless that was done."""
    if (objective := checked or await _check_held(agent, cid)) is not None:
        size = f"{plural(objective.count, 'message')}, {format_duration(objective.duration_ns)}"
        facts = {"objective": cid, "messages": objective.count, "seconds": objective.duration_ns / 1e9}
        printer.line(f"objective {cid}: {size}", kind="objective", **facts)
    try:
        order = await agent.order(cid, retry=retry, **terms)
    except RemoteError as error:
        if error.code == "no-robot-fits":
            error.hint = "give a higher --max-cost, or see `aira quotes`"
        raise
    printer.number = order.hash[:16] if retry else ""
    printer.posted(order)
    if retry:
        printer.line(f"job {printer.number}: {retry + 1} attempts at most until then")
    if printer.on_stop:
        said = f"if you stop the job after it has begun, {printer.stop_cost}"
        printer.line(said, kind="on-stop", cost=printer.on_stop)
    return order


async def _address_of(agent: Agent, robot: str) -> str:
    """The address of the robot that is named. Raises as `robot_address`."""
    model = await agent.parts.chain.names.model(agent.model)
    address = await robot_address(agent.network.session, agent.channel, robot, model=model)
    await agent.parts.robots.find(address)  # for those who show its name
    return address


async def _contract(
    agent: Agent, order: Order | Contract, printer: JobPrinter, *, withdraw_on_exit: bool, wait: bool
) -> Contract:
    """Wait until an order is a contract. When that is interrupted, say what becomes of the order, or withdraw it."""
    from mesh.agent.contracts import Contract, Progress

    if isinstance(order, Contract):
        await agent.parts.robots.find(order.liability.promisor)
        printer(Progress(kind="contract", agent=order.liability.promisor, detail=order.address))
        return order
    try:
        async with Background() as tasks:
            tasks.start(_say_who_is_present(agent, printer), "silence")
            return await order.contract(on_progress=printer, wait=wait)
    except asyncio.CancelledError:
        await _leave(agent, order, withdraw_on_exit=withdraw_on_exit)
        raise
    except OrderExpired:
        if printer.is_silent:
            click.echo(f"no robot offered or declined; {await _who_is_here(agent)}", err=True)
        else:
            click.echo(printer.summary(), err=True)
        raise


async def _leave(agent: Agent, order: Order, *, withdraw_on_exit: bool) -> None:
    """When the command ends before an order is a contract, withdraw it, or say what becomes of it."""
    if withdraw_on_exit:
        for line in withdrawal_lines(await withdraw_orders(agent.parts, [order], on_chain=False)):
            click.echo(line, err=True)
    else:
        click.echo(await _stays(agent, order), err=True)


async def _say_who_is_present(agent: Agent, printer: JobPrinter) -> None:
    """If no robot offers or declines for a while, say who is there to do so."""
    await asyncio.sleep(DEMAND_PACE.silence)
    if printer.is_silent:
        click.echo(f"no robot has offered or declined yet; {await _who_is_here(agent)}", err=True)


async def _say_how_far_it_read(agent: Agent) -> None:
    """While the agent reads the blocks since its last run, say so: it learns of the contract when it has read that."""
    while True:
        await asyncio.sleep(DEMAND_PACE.silence)
        read = agent.parts.chain_head.head
        with suppress(AiraError):
            if (head := await agent.parts.chain.block_number()) - read > BEHIND:
                text = f"reading the chain: block {read:,} of {head:,}; the contract is seen when that is done"
                click.echo(text, err=True)
                continue
        return


async def _who_is_here(agent: Agent) -> str:
    """How many robots of the demanded model are present, by what they say of themselves, and how many others."""
    from mesh.watching import PROVIDER, present, statuses

    peers, model = await present(agent.channel, "agent", PROVIDER), await agent.parts.chain.names.model(agent.model)
    others = [peer for peer in peers if peer.role == "agent" and peer.address != agent.address]
    stated = await statuses(agent.network.session, agent.channel, others)
    models = [getattr(status, "model", None) for status in stated.values()]
    robots = sum(one in (model, agent.model) for one in models)
    providers = plural(sum(peer.role == PROVIDER for peer in peers), "provider")
    where = agent.channel.lighthouse
    if robots:
        return f"{plural(robots, 'robot')} of this model and {providers} are present on {where}"
    silent = f", {models.count(None)} of which do not say what they are" if None in models else ""
    return f"no robot of this model is here: {plural(len(others), 'other agent')}{silent}, and {providers} on {where}"


async def _stays(agent: Agent, order: Order) -> str:
    """Until when an order stays open, and how to withdraw it."""
    until = f"the demand stays valid until block {order.deadline:,}"
    try:
        async with asyncio.timeout(DEMAND_PACE.validity):
            chain = agent.parts.chain
            blocks = order.deadline - await chain.contract_block()
            seconds = blocks * (await chain.node.contract_blocks.seconds(blocks) or 0)
    except (AiraError, TimeoutError):
        seconds = 0
    about = f", for about {plural(round(seconds / 60) or 1, 'minute')}" if seconds > 0 else ""
    return f"{until}{about}; withdraw it with `aira order withdraw {order.hash[:16]}`"


async def _wait_for_end(
    agent: Agent, contract: Contract, printer: JobPrinter, out: Path | None, *, withdraw_on_exit: bool
) -> None:
    """Wait for the end, keep the recording, and print both. Then raises what failed."""

    def seen(progress: Progress) -> None:
        printer(progress)
        if progress.kind == "again":
            with suppress(BrokenPipeError):
                for order in _orders_of(agent, contract):
                    printer.posted(order)

    waiting = asyncio.create_task(contract.outcome(on_progress=seen), name=f"end of {contract.address}")

    async def leave() -> None:
        for order in _orders_of(agent, contract):
            await _leave(agent, order, withdraw_on_exit=withdraw_on_exit)

    try:
        outcome = await _interruptible(contract, waiting, printer, leave)
    finally:
        waiting.cancel()
    facts: dict[str, Any] = {"liability": contract.address, "success": outcome.success, "result": outcome.result}
    facts |= {"robot": outcome.robot, **_attempts(printer.number, outcome)}
    if contract.liability.validator != ZERO_ADDRESS:
        facts["reports"] = [decode_json(one.encode()) for one in outcome.reports]
    printer.close()
    printer.line(f"{'paid' if outcome.success else 'refunded'}, result {outcome.result or 'none'}")
    failure: AiraError | None = None
    if not outcome.success:
        why = f"{printable(outcome.reason)} ({outcome.code})" if outcome.reason else "nothing says why"
        owed, money = 0, "the cost was returned"
        hint = f"it ended without a result; see `aira liability show {contract.address}`"
        if outcome.result:
            hint = f"the recording shows more: `aira objective show {outcome.result}`"
        with suppress(AiraError):  # then the node does not say
            liabilities = agent.parts.chain.liabilities
            owed = await liabilities.owed_after(await liabilities.get(contract.address))
        if owed:
            money = f"the token refused to return the cost, `aira liability claim {contract.address}` takes it"
            facts["owed"] = str(owed)
        failure = RemoteError(f"the job was not done: {why}; {money}", hint=hint, code="job-not-done")
        facts |= {"error": str(failure), "reason": outcome.reason, "code": outcome.code}
    try:
        facts["recording"] = None if not outcome.result else str(await _keep_recording(contract, out))
    except AiraError as error:
        facts["recording"] = None
        if out is not None:
            failure, facts["error"] = error, str(error)
        elif outcome.success:
            later = f"`aira objective get {outcome.result}` fetches it when the robot is present"
            click.echo(f"aira: {error}\n      {later}", err=True)
    if printer.as_json:
        print_json(facts)
    elif facts["recording"]:
        print_line(f"recording {facts['recording']}")
    if printer.number:
        attempts = plural(len(outcome.earlier) + 1, "attempt")
        printer.line(f"job {printer.number}: {'done' if outcome.success else 'not done'} in {attempts}")
    if failure is not None:
        raise failure


def _orders_of(agent: Agent, contract: Contract) -> list[Order]:
    """The order for another attempt at a job, while it is no contract."""
    return [order for order in agent.orders() if order.hash == contract.order]


def _attempts(number: str, outcome: Outcome) -> dict[str, Any]:
    """The number of a job that may have several attempts, and those that failed, for JSON."""
    if not number:
        return {}
    fields = {"liability": "contract", "robot": "robot", "code": "code", "reason": "reason", "result": "result"}
    earlier = [{name: getattr(one, field) for name, field in fields.items()} for one in outcome.earlier]
    return {"number": number, "earlier": earlier}


async def _interruptible(
    contract: Contract, waiting: asyncio.Task[Outcome], printer: JobPrinter, leave: Callable[[], Awaitable[None]]
) -> Outcome:
    """What `waiting` returns. If it is interrupted in a terminal, another Ctrl-C stops the robot.

    Without another one, `leave` is called.
    """
    try:
        return await asyncio.shield(waiting)
    except asyncio.CancelledError:
        printer.close()
        if printer.has_contract:
            goes_on = f"the contract goes on; `aira liability watch {contract.address}` waits for its end"
            click.echo(f"{goes_on}, `aira liability show` says from when the cost can be refunded", err=True)
        if printer.number:
            click.echo(f"job {printer.number}: not ordered again when this command has ended", err=True)
        is_again = sys.stderr.isatty() and await _is_interrupted_again(waiting, printer)
        if not is_again and not waiting.done():
            await leave()
            raise
    if is_again:
        await _stop(contract, printer)
    return await waiting


async def _is_interrupted_again(waiting: asyncio.Task[Outcome], printer: JobPrinter) -> bool:
    """Whether Ctrl-C is pressed again in time, and before the contract has ended."""
    again = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGINT, again.set)
    pressing = loop.create_task(again.wait(), name="Ctrl-C")
    try:
        cost = f" ({printer.stop_cost})" if printer.on_stop else ""
        click.echo(f"press Ctrl-C again within {DEMAND_PACE.stop_prompt:g} seconds to stop the robot{cost}", err=True)
        await asyncio.wait([pressing, waiting], timeout=DEMAND_PACE.stop_prompt, return_when=asyncio.FIRST_COMPLETED)
    finally:
        pressing.cancel()
        loop.remove_signal_handler(signal.SIGINT)
    return again.is_set()


async def _stop(contract: Contract, printer: JobPrinter) -> None:
    """Stop the job of a contract, and say what the robot's devices say. Raises `ServiceFailed` without an answer."""
    from mesh.network import ServiceFailed

    printer.close()
    click.echo("\nstopping the robot; Ctrl-C leaves without waiting for the end", err=True)
    try:
        stopped = await contract.stop("the customer pressed Ctrl-C")
    except ServiceFailed as error:
        if error.reason != "agent-error":
            click.echo(f"the robot may go on; `aira liability stop {contract.address}` tries again", err=True)
            raise
        click.echo(f"aira: {error}", err=True)  # the job has just ended
        return
    printer.close()
    devices = [decode_json(one.encode()) for one in stopped.devices]
    printer.line("the job is stopped", kind="stopped", devices=devices)
    for line in device_lines(stopped):
        click.echo(line, err=True)


async def _on_stop(agent: Agent) -> str:
    """What the model's description says of the cost of a job that is stopped; empty without a description."""
    described = await agent.runtime.models.find(await agent.parts.chain.names.model(agent.model))
    return "" if described is None else described.on_stop


async def _keep_recording(contract: Contract, out: Path | None) -> Path:
    """Where the recording is: in the account's store, or its copy. Raises `ContentError`, `AiraError`."""
    recording = await contract.recording()
    if out is None:
        return recording
    try:
        await asyncio.to_thread(shutil.copyfile, recording, out)
    except OSError as error:
        raise AiraError(
            f"can't write the recording to {out}: {error.strerror}",
            hint=f"the store has it: {recording}",
            code="output-failed",
        ) from None
    return out
