"""`aira watch`: prints what happens on a market, one line for each event."""

from __future__ import annotations

import asyncio
import signal
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.agent.contracts import verdict_words
from mesh.amounts import XRT, Unit
from mesh.base.background import Background
from mesh.base.flood import BoundedDict, Rate, RateLimiter
from mesh.cli.chain_client import open_chain
from mesh.cli.demand import print_connection_changes
from mesh.cli.files import model_named
from mesh.cli.options import CHAIN_SETTINGS, FILE, with_json, with_settings
from mesh.cli.output import json_text, plural, print_json, print_line, printable, short_address, wait_for_broken_pipe
from mesh.errors import AiraError, ChainError
from mesh.network import Reading
from mesh.role.running import run_until_stopped
from mesh.settings import NetworkSettings
from mesh.telemetry.logs import configure_logging
from mesh.watching import JobEvent, PresenceChange, labelled
from schemas import Demand, InvalidAddress, Offer, Result, Verified, parse_address
from schemas.decoding import decode_json
from schemas.signing import Decline, Rejection
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping
    from pathlib import Path

    import zenoh

    from mesh.chain import Chain
    from mesh.network import Channel, Network
    from mesh.recording import Recorder
    from mesh.settings import Settings
    from mesh.watching import MarketCounters, MarketEvent, MarketWatch, RobotDirectory
    from schemas import PresenceKey


LONGEST_TEXT: Final = 200
"""The most characters of a text from others that are shown."""
HASH_DIGITS: Final = 8
"""Digits of an order's hash in a line; JSON has all 64."""


def robot_in(seen: MarketEvent | PresenceChange) -> str:
    """The address of the robot that an event is about; empty if it is about none."""
    match seen:
        case Verified():
            return "" if isinstance(seen.message, Demand) else seen.signer
        case Decline() | Reading() | JobEvent():
            return seen.agent
    return ""


def event_json(seen: MarketEvent | PresenceChange, *, time: str, name: str = "") -> dict[str, Any]:
    """An event at `time` (ISO 8601) for JSON. Amounts are text, in the smallest unit. `name` is that of its robot."""
    match seen:
        case Verified():
            message = seen.message
            about: dict[str, Any] = {"event": type(message).__name__.lower(), "hash": seen.hash.hex()}
            about["signer"] = seen.signer
            if isinstance(message, Result):
                about |= {"liability": message.liability, "result": message.result, "success": message.success}
            else:
                about |= _order_facts(message)
        case Rejection():
            about = {"event": "rejected", "order": seen.order, "provider": seen.provider}
            about |= {"reason": seen.reason, "detail": seen.detail}
        case Decline():
            about = {"event": "declined", "order": seen.order, "agent": seen.agent}
            about |= {"code": seen.code, "detail": seen.detail}
        case ValidatorReport():
            about = {"event": "judged", **decode_json(seen.encode())}
        case Reading():
            about = {"event": "reading", "agent": seen.agent, "topic": seen.topic, "value": seen.value}
            if seen.result:
                about |= {"signer": seen.agent, "result": seen.result}
        case PresenceChange((role, address), is_present):
            about = {"event": "present" if is_present else "gone", "role": role, "agent": address}
        case JobEvent(agent, event, liability):
            about = {"event": event, "agent": agent, "liability": decode_json(liability.encode())}
    return {"time": time} | about | ({"name": name} if name else {})


def _order_facts(order: Demand | Offer) -> dict[str, Any]:
    fee = "validator" if isinstance(order, Demand) else "lighthouse"
    return {
        "model": order.model,
        "objective": order.objective,
        "token": order.token,
        "cost": str(order.cost),
        "lighthouse": order.lighthouse,
        "validator": order.validator,
        f"{fee}Fee": str(getattr(order, f"{fee}_fee")),
        "deadline": order.deadline,
        "generation": order.generation,
    }


class EventFormatter:
    """Formats events as lines for people, with the `units` of tokens (by address) that are known."""

    def __init__(self, units: Mapping[str, Unit]) -> None:
        self._units = units

    def line(self, seen: MarketEvent | PresenceChange, name: str = "") -> str:
        """The line of an event, without the time. `name` is what the robot calls itself that it is about."""
        robot = robot_in(seen)
        who = labelled(robot, name) if name else short_address(robot)
        match seen:
            case Verified():
                message, kind = seen.message, type(seen.message).__name__.lower()
                if isinstance(message, Result):
                    words = f"{message.result}  {_ended(message.success)}, for {message.liability}, signed by {who}"
                else:
                    words = self._order(seen, labelled(seen.signer, name))
            case Rejection():
                why = printable(seen.detail[:LONGEST_TEXT] or seen.reason[:LONGEST_TEXT])
                kind, words = "rejected", f"{seen.order[:HASH_DIGITS]} by {short_address(seen.provider)}: {why}"
            case Decline():
                why = f"{printable(seen.detail[:LONGEST_TEXT])} ({seen.code})".lstrip()
                kind, words = "declined", f"{seen.order[:HASH_DIGITS]} by {who}: {why}"
            case ValidatorReport():
                why = printable(verdict_words(seen)[:LONGEST_TEXT])
                kind, words = "judged", f"{seen.liability} by juror {short_address(seen.juror)}: {why}"
            case Reading():
                text = seen.value if isinstance(seen.value, str) else json_text(seen.value)
                shown = printable(text[:LONGEST_TEXT] + ("…" if len(text) > LONGEST_TEXT else ""))
                kind, words = "reading", f"{printable(seen.topic)}  {shown}, from {who}"
            case PresenceChange((role, address), is_present):
                kind, words = "present" if is_present else "gone", f"{printable(role)} {address}"
            case JobEvent(_, kind, liability):
                parties = f"{who} for {short_address(liability.promisee)}"
                words = f"{liability.address}  {parties}, {self.cost(liability.cost, liability.token)}"
                if liability.result:
                    words += f", {_ended(liability.is_success)}: {liability.result}"
        return f"{kind:<9}  {words}"

    def cost(self, amount: int, token: str) -> str:
        """An amount of a token with its unit."""
        return (self._units.get(token) or Unit(f"units of {short_address(token)}", 0)).show(amount)

    def _order(self, seen: Verified[Any], who: str) -> str:
        order: Demand | Offer = seen.message
        if isinstance(order, Demand):
            does, fee = "pays", ""
        else:
            does = "works for"
            fee = f" and {XRT.show(order.lighthouse_fee)} to the provider" if order.lighthouse_fee else ""
        terms = f"{self.cost(order.cost, order.token)}{fee}, model {_short_cid(order.model)}"
        more = f"objective {_short_cid(order.objective)}, until block {order.deadline:,}"
        return f"{seen.hash.hex()[:HASH_DIGITS]}  {who} {does} {terms}, {more}"


UNIT_QUESTIONS: Final = Rate(per_second=1.0, burst=20)
"""Tokens that the node is asked about: strangers may name any."""


class KnownUnits:
    """The units of tokens by address: that of `xrt`, and of others as far as the settings' chain says it."""

    def __init__(self, settings: Settings, xrt: str | None) -> None:
        self.known: BoundedDict[str, Unit] = BoundedDict(1024)
        if xrt is not None:
            self.known[xrt] = XRT
        self._settings = settings
        self._chain: Chain | None = None
        self._limiter = RateLimiter(per_sender=UNIT_QUESTIONS)

    async def use_chain(self) -> None:
        """Ask the chain of the settings, if its node answers, until cancelled."""
        with suppress(AiraError):
            async with open_chain(self._settings) as self._chain:
                await asyncio.Event().wait()

    async def learn(self, token: str) -> None:
        """Ask for the unit of a token, if it is not known."""
        if self._chain is None or token in self.known or not self._limiter.allow(""):
            return
        with suppress(ChainError, TimeoutError):
            async with asyncio.timeout(1):
                for address, unit in (await self._chain.tokens.units([token])).items():
                    self.known[address] = unit


def token_in(seen: MarketEvent | PresenceChange) -> str:
    """The token (address) that an event has an amount of; empty if it has none."""
    match seen:
        case Verified(message=Demand() | Offer() as order):
            return order.token
        case JobEvent(liability=liability):
            return liability.token
    return ""


def _short_cid(cid: str) -> str:
    """A CID shortened to its ends, for lines with a full one beside it."""
    return f"{cid[:6]}…{cid[-4:]}"


def _ended(success: bool) -> str:
    return "done" if success else "not done"


PRESENCE_CHANGES: Final = Rate(per_second=4.0, burst=64)
"""Validators that are shown as they come and go; more are left out."""


@click.command("watch")
@click.option("--model", help="print only events of this model: its file or CID")
@click.option("--open", "with_open", is_flag=True, help="first print the orders that are open now")
@click.option("--readings", is_flag=True, help="also print what agents publish outside of jobs, and their answers")
@click.option("--out", type=FILE, help="record the readings to this MCAP file (new)")
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", *CHAIN_SETTINGS)
def command(
    settings: Settings, model: str | None, with_open: bool, readings: bool, out: Path | None, as_json: bool
) -> None:
    """Print one line for each event on a lighthouse's channel: orders, rejections, declines, contracts, jobs,
    results, validators' verdicts, and which validators are present. Ctrl-C stops it.

    Needs a router, but no account and no chain; without the chain's node, amounts of other tokens than XRT are in their
    smallest unit. Prints only orders and results with valid signatures; invalid messages
    are counted, and the counts are printed at the end and on SIGUSR1. --json prints one object per line, with amounts
    in the token's smallest unit. With --model, only results of contracts seen since the start are printed.

    Agents report the contracts; `aira liability watch` reads them from the chain.

    --readings also prints what agents publish outside of jobs, such as the state of a battery, and the content of their
    answers (results without a contract), of any model. --out records them; their topics begin with the agent's address.
    """
    configure_logging(level="warning")
    run_until_stopped(
        lambda: watch(
            settings, model, with_open=with_open, readings=readings or out is not None, out=out, as_json=as_json
        )
    )


async def watch(
    settings: Settings,
    model: str | None,
    *,
    with_open: bool,
    as_json: bool,
    readings: bool = False,
    out: Path | None = None,
) -> None:
    from mesh.role.composition import watching
    from mesh.watching import MarketWatch, ReadingFetcher, RobotDirectory

    if model is not None:
        model = (await asyncio.to_thread(model_named, model)).cid()
    async with AsyncExitStack() as stack:
        network, channel = await stack.enter_async_context(watching(settings))
        xrt = None if as_json else await _xrt(settings, network.session, channel)
        units = KnownUnits(settings, xrt)
        formatter = None if as_json else EventFormatter(units.known)
        recorder = None if out is None else await stack.enter_async_context(_recording(out, channel.lighthouse))
        robots = RobotDirectory(network.session, channel)
        show = partial(_show_event, formatter, recorder, robots)
        fetcher = await stack.enter_async_context(ReadingFetcher(network.session, show)) if readings else None
        watched = MarketWatch(network.session, channel, model=model or "*", readings=readings)
        seen = await stack.enter_async_context(watched)
        tasks = await stack.enter_async_context(_report_beside(network, seen))
        if not as_json:
            tasks.start(units.use_chain(), "chain")
            click.echo(f"watching {channel.lighthouse}; Ctrl-C stops it", err=True)
        if model is None:
            _show_validators(channel, show)
        if with_open:
            tasks.start(seen.recall(), "open orders")
        async for event in seen:
            if robot := robot_in(event):
                await robots.find(robot)
            if token := token_in(event):
                await units.learn(token)
            show(event)
            if fetcher is not None:
                fetcher.handle(event)


def _show_validators(channel: Channel, show: Callable[[PresenceChange], None]) -> None:
    """Show each juror that is present now, and from now on who comes and who goes. Anybody may announce any number."""
    from mesh.watching import PresenceChange, PresentPeer

    limiter = RateLimiter(per_sender=PRESENCE_CHANGES)

    def changed(key: PresenceKey, *, is_present: bool) -> None:
        if limiter.allow(""):
            with suppress(BrokenPipeError):  # `wait_for_broken_pipe` ends the command
                show(PresenceChange(PresentPeer(key.role, parse_address(key.agent)), is_present))

    appeared, gone = partial(changed, is_present=True), partial(changed, is_present=False)
    channel.watch_presence(appeared, gone=gone, role="validator")


@asynccontextmanager
async def _recording(out: Path, lighthouse: str) -> AsyncIterator[Recorder]:
    """The recorder of readings, which says at the end how many it has."""
    from mesh.recording import Recorder, RecordingAbout

    recorder = await asyncio.to_thread(Recorder, out, RecordingAbout(lighthouse=lighthouse))
    try:
        yield recorder
    finally:
        summary = await asyncio.to_thread(recorder.close)
        click.echo(f"{out}: {plural(summary.messages, 'reading')}", err=True)


def _show_event(
    formatter: EventFormatter | None,
    recorder: Recorder | None,
    robots: RobotDirectory,
    event: MarketEvent | PresenceChange,
) -> None:
    """Print an event: as a line by `formatter`, without one as JSON. Record it if it is a reading."""
    if isinstance(event, Reading) and recorder is not None:
        recorder.record(f"/{event.agent.lower()}{event.topic}", event.payload, event.type)
    now, name = datetime.now(UTC), robots.name(robot_in(event))
    if formatter is None:
        time = now.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        print_json(event_json(event, time=time, name=name))
    else:
        print_line(f"{now.astimezone():%H:%M:%S}  {formatter.line(event, name)}")


@asynccontextmanager
async def _report_beside(network: Network, seen: MarketWatch) -> AsyncIterator[Background]:
    """Print to stderr when the router is unreachable, and the counters on SIGUSR1 and at the end."""
    loop = asyncio.get_running_loop()

    def print_counters() -> None:
        click.echo(format_counters(seen.counters()), err=True)

    loop.add_signal_handler(signal.SIGUSR1, print_counters)
    try:
        async with Background() as tasks:
            tasks.start(print_connection_changes(network), "network losses")
            tasks.start(wait_for_broken_pipe(), "readers of stdout")
            yield tasks
    except asyncio.CancelledError:  # by Ctrl-C; a closed pipe ends quietly
        print_counters()
        raise
    finally:
        loop.remove_signal_handler(signal.SIGUSR1)


def format_counters(counters: MarketCounters) -> str:
    """The counters in one line."""
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in sorted(counters.refused.items()))
    invalid = f"{sum(counters.refused.values()):,} invalid" + (f" ({reasons})" if reasons else "")
    lost = f", {counters.lost:,} lost because this reader was too slow" if counters.lost else ""
    return f"{plural(counters.received, 'message')} received, {counters.duplicate:,} duplicate, {invalid}{lost}"


async def _xrt(settings: Settings, session: zenoh.Session, channel: Channel) -> str | None:
    """The address of XRT: from the settings or, if these contain a name, from the market's providers.

    None if no provider answers, or they disagree.
    """
    from mesh.watching import present, statuses
    from schemas.status import Status

    try:
        return parse_address(settings.xrt_contract)
    except InvalidAddress:
        found = await statuses(session, channel, await present(channel, "provider"))
    named = {how.xrt for how in found.values() if isinstance(how, Status) and how.xrt}
    return named.pop() if len(named) == 1 else None
