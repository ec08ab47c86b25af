"""`aira watch`: prints what happens on a market."""

from __future__ import annotations

import asyncio
import signal
from contextlib import AsyncExitStack, asynccontextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from mesh.agent.judged_contract import verdict_words
from mesh.amounts import XRT, Unit
from mesh.background import Background
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import json_text, plural, print_json, print_line, printable, short_address, wait_for_broken_pipe
from mesh.cli.waiting import print_connection_changes
from mesh.network import Reading
from mesh.running import run_until_stopped
from mesh.settings import NetworkSettings, options_of
from mesh.telemetry.logs import configure_logging
from mesh.watching import JobEvent
from schemas import Demand, Empty, InvalidAddress, Result, String, Verified, parse_address, parse_cid
from schemas.signing import Decline, Rejection
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from mesh.network import Channel, Network
    from mesh.recording import Recorder
    from mesh.settings import Settings
    from mesh.watching import MarketCounters, MarketEvent, MarketWatch
    from schemas import Liability, Offer

LONGEST_TEXT: Final = 200
"""The most characters of a text from others that are shown."""
HASH_DIGITS: Final = 8
"""Digits of an order's hash in a line; JSON has all 64."""
EVENT_WIDTH: Final = 9
"""Columns of the event's name."""


@click.command("watch")
@click.option("--model", help="print only events of this model (CID)")
@click.option("--open", "with_open", is_flag=True, help="first print the orders that are open now")
@click.option("--readings", is_flag=True, help="also print what agents publish outside of jobs, and their answers")
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), help="record the readings to this MCAP file (new)"
)
@with_json
@with_settings(*options_of(NetworkSettings), "lighthouse_contract", "xrt_contract")
def command(
    settings: Settings, model: str | None, with_open: bool, readings: bool, out: Path | None, as_json: bool
) -> None:
    """Print one line for each event on a lighthouse's channel: orders, rejections, declines, contracts, jobs,
    results and validators' verdicts. Ctrl-C stops it.

    Needs a router, but no account and no chain. Prints only orders and results with valid signatures; invalid messages
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
    from mesh.agent.components import watching
    from mesh.watching import MarketWatch, ReadingFetcher

    if model is not None:
        parse_cid(model)
    async with AsyncExitStack() as stack:
        network, channel = await stack.enter_async_context(watching(settings))
        formatter = None if as_json else EventFormatter(await _xrt(settings, network.session, channel))
        recorder = None if out is None else await stack.enter_async_context(_recording(out, channel.lighthouse))
        show = partial(_show_event, formatter, recorder)
        fetcher = await stack.enter_async_context(ReadingFetcher(network.session, show)) if readings else None
        watched = MarketWatch(network.session, channel, model=model or "*", readings=readings)
        seen = await stack.enter_async_context(watched)
        tasks = await stack.enter_async_context(_report_beside(network, seen))
        if not as_json:
            click.echo(f"watching {channel.lighthouse}; Ctrl-C stops it", err=True)
        if with_open:
            tasks.start(seen.recall(), "open orders")
        async for event in seen:
            show(event)
            if fetcher is not None:
                fetcher.handle(event)


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


def _show_event(formatter: EventFormatter | None, recorder: Recorder | None, event: MarketEvent) -> None:
    """Print an event: as a line by `formatter`, without one as JSON. Record it if it is a reading."""
    if isinstance(event, Reading) and recorder is not None:
        recorder.record(f"/{event.agent.lower()}{event.topic}", event.payload, event.type)
    now = datetime.now(UTC)
    if formatter is None:
        print_json(event_json(event, time=now.isoformat(timespec="milliseconds").replace("+00:00", "Z")))
    else:
        print_line(f"{now.astimezone():%H:%M:%S}  {formatter.line(event)}")


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


def event_json(seen: MarketEvent, *, time: str) -> dict[str, Any]:
    """An event at `time` (ISO 8601) for JSON. Amounts are text, in the smallest unit."""
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
            about = {"event": "judged", **msgspec.json.decode(seen.encode())}
        case Reading():
            about = {"event": "reading", "agent": seen.agent, "topic": seen.topic, "value": _value(seen)}
            if seen.result:
                about |= {"signer": seen.agent, "result": seen.result}
        case JobEvent(agent, event, liability):
            about = {"event": event, "agent": agent, "liability": msgspec.json.decode(liability.encode())}
    return {"time": time} | about


def _order_facts(order: Demand | Offer) -> dict[str, Any]:
    if isinstance(order, Demand):
        fee = {"validatorFee": str(order.validator_fee)}
    else:
        fee = {"lighthouseFee": str(order.lighthouse_fee)}
    return {
        "model": order.model,
        "objective": order.objective,
        "token": order.token,
        "cost": str(order.cost),
        "lighthouse": order.lighthouse,
        "validator": order.validator,
        **fee,
        "deadline": order.deadline,
        "generation": order.generation,
    }


class EventFormatter:
    """Formats events as lines for people. `xrt` is the address of XRT, None if unknown."""

    def __init__(self, xrt: str | None) -> None:
        self._xrt = xrt

    def line(self, seen: MarketEvent) -> str:
        """The line of an event, without the time."""
        match seen:
            case Verified():
                message, kind = seen.message, type(seen.message).__name__.lower()
                words = self._result(message, seen.signer) if isinstance(message, Result) else self._order(seen)
            case Rejection():
                why = printable(seen.detail[:LONGEST_TEXT] or seen.reason[:LONGEST_TEXT])
                kind, words = "rejected", f"{seen.order[:HASH_DIGITS]} by {short_address(seen.provider)}: {why}"
            case Decline():
                why = f"{printable(seen.detail[:LONGEST_TEXT])} ({seen.code})".lstrip()
                kind, words = "declined", f"{seen.order[:HASH_DIGITS]} by {short_address(seen.agent)}: {why}"
            case ValidatorReport():
                why = printable(verdict_words(seen)[:LONGEST_TEXT])
                kind, words = "judged", f"{seen.liability} by juror {short_address(seen.juror)}: {why}"
            case Reading():
                kind, words = "reading", f"{printable(seen.topic)}  {_shown(seen)}, from {short_address(seen.agent)}"
            case JobEvent(_, kind, liability):
                words = self._work(liability)
        return f"{kind:<{EVENT_WIDTH}}  {words}"

    def cost(self, amount: int, token: str) -> str:
        """An amount of a token with its unit."""
        return (XRT if token == self._xrt else Unit(f"units of {short_address(token)}", 0)).show(amount)

    def _order(self, seen: Verified[Any]) -> str:
        order: Demand | Offer = seen.message
        if isinstance(order, Demand):
            does, fee = "pays", ""
        else:
            does = "works for"
            fee = f" and {XRT.show(order.lighthouse_fee)} to the provider" if order.lighthouse_fee else ""
        terms = f"{self.cost(order.cost, order.token)}{fee}, model {_short_cid(order.model)}"
        more = f"objective {_short_cid(order.objective)}, until block {order.deadline:,}"
        return f"{seen.hash.hex()[:HASH_DIGITS]}  {seen.signer} {does} {terms}, {more}"

    def _result(self, result: Result, signer: str) -> str:
        return f"{result.result}  {_ended(result.success)}, for {result.liability}, signed by {short_address(signer)}"

    def _work(self, job: Liability) -> str:
        parties = f"{short_address(job.promisor)} for {short_address(job.promisee)}, {self.cost(job.cost, job.token)}"
        return f"{job.address}  {parties}" + (f", {_ended(job.is_success)}: {job.result}" if job.result else "")


def _value(reading: Reading) -> Any:
    """The value of a reading for JSON, in which bytes become base64."""
    value = reading.value
    return value.data if isinstance(value, String) else None if isinstance(value, Empty) else value


def _shown(reading: Reading) -> str:
    value = _value(reading)
    text = value if isinstance(value, str) else json_text(value)
    return printable(text[:LONGEST_TEXT] + ("…" if len(text) > LONGEST_TEXT else ""))


def _short_cid(cid: str) -> str:
    """A CID shortened to its ends, for lines with a full one beside it."""
    return f"{cid[:6]}…{cid[-4:]}"


def _ended(success: bool) -> str:
    return "done" if success else "not done"
