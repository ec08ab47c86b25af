"""`aira watch`: a market as it happens."""

from __future__ import annotations

import asyncio
import signal
from contextlib import AsyncExitStack, asynccontextmanager
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

import click

from mesh.background import Background
from mesh.cli.options import with_settings
from mesh.cli.pipes import until_unread
from mesh.cli.printing import plural, print_json, say, with_json
from mesh.running import run_until_stopped
from mesh.settings import NetworkSettings, options_of
from mesh.telemetry.logs import start_log
from schemas import InvalidAddress, parse_address, parse_cid

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from mesh.cli.happenings import Words
    from mesh.network import Channel, Network
    from mesh.settings import Settings
    from mesh.watching import MarketWatch, Reading, Seen, Tally


@click.command("watch")
@click.option("--model", help="only what concerns this model (CID)")
@click.option("--open", "with_open", is_flag=True, help="begin with the orders that are open now")
@click.option("--readings", is_flag=True, help="show what Results without a contract hold, such as a sensor's readings")
@with_json
@with_settings(*options_of(NetworkSettings), "lighthouse_contract", "xrt_contract")
def command(settings: Settings, model: str | None, with_open: bool, readings: bool, as_json: bool) -> None:
    """Tell what happens on a lighthouse, a line each: orders, rejections, contracts and their work, Results. Ctrl-C
    ends it.

    It needs a router, no account and no chain. Orders and Results are shown when their signatures are right; what is
    refused is counted, and said at the end, or when SIGUSR1 comes. With --json an object a line, amounts in the
    token's smallest unit. With --model, Results are those of contracts whose agents have told of them meanwhile.

    That a contract was made is what agents say; `aira liability watch` asks the chain.
    """
    start_log(level="warning")
    run_until_stopped(lambda: _watch(settings, model, with_open=with_open, readings=readings, as_json=as_json))


async def _watch(
    settings: Settings, model: str | None, *, with_open: bool, as_json: bool, readings: bool = False
) -> None:
    from mesh.agent.components import watching
    from mesh.cli.happenings import Words
    from mesh.watching import MarketWatch, Readings

    if model is not None:
        parse_cid(model)
    async with AsyncExitStack() as stack:
        network, channel = await stack.enter_async_context(watching(settings))
        words = None if as_json else Words(await _xrt(settings, network.session, channel))
        tell = partial(_tell, words)
        looking = await stack.enter_async_context(Readings(network.session, tell)) if readings else None
        seen = await stack.enter_async_context(MarketWatch(network.session, channel, model=model or "*"))
        tasks = await stack.enter_async_context(_beside(network, seen))
        if not as_json:
            click.echo(f"watching {channel.lighthouse}; Ctrl-C ends it", err=True)
        if with_open:
            tasks.start(seen.recall(), "open orders")
        async for something in seen:
            tell(something)
            if looking is not None:
                looking.see(something)


def _tell(words: Words | None, something: Seen | Reading) -> None:
    """Print what happened: in `words` for people, as JSON where there are none."""
    from mesh.cli.happenings import facts

    now = datetime.now(UTC)
    if words is None:
        print_json(facts(something, time=now.isoformat(timespec="milliseconds").replace("+00:00", "Z")))
    else:
        say(f"{now.astimezone():%H:%M:%S}  {words.line(something)}")


@asynccontextmanager
async def _beside(network: Network, seen: MarketWatch) -> AsyncIterator[Background]:
    """Meanwhile say to stderr when the router is lost, and what was refused when SIGUSR1 asks for it and at the end."""
    loop = asyncio.get_running_loop()

    def tell() -> None:
        click.echo(told(seen.tally()), err=True)

    loop.add_signal_handler(signal.SIGUSR1, tell)
    try:
        async with Background() as tasks:
            tasks.start(_say_losses(network), "network losses")
            tasks.start(until_unread(), "readers of stdout")
            yield tasks
    except asyncio.CancelledError:  # by Ctrl-C; who has closed the pipe wants to hear no more
        tell()
        raise
    finally:
        loop.remove_signal_handler(signal.SIGUSR1)


def told(tally: Tally) -> str:
    """What came by, in a line for people."""
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in sorted(tally.refused.items()))
    refused = f"{sum(tally.refused.values()):,} refused" + (f" ({reasons})" if reasons else "")
    lost = f", {tally.lost:,} lost as this reader was too slow" if tally.lost else ""
    return f"{plural(tally.received, 'message')} came by, {tally.duplicate:,} of them again, {refused}{lost}"


async def _say_losses(network: Network) -> None:
    async for _ in network.changes():
        words = "the router is back" if network.connected else "the router is gone; waiting for it"
        click.echo(f"aira: {words}", err=True)


async def _xrt(settings: Settings, session: zenoh.Session, channel: Channel) -> str | None:
    """The address of XRT: the one of the settings or, where these have a name, what the market's providers say.

    None where nobody says it, or not all the same.
    """
    from mesh.watching import present, statuses
    from schemas.status import Status

    try:
        return parse_address(settings.xrt_contract)
    except InvalidAddress:
        providers = [peer for peer in await present(channel) if peer.role == "provider"]
        told = await statuses(session, channel, providers)
    named = {how.xrt for how in told.values() if isinstance(how, Status) and how.xrt}
    return named.pop() if len(named) == 1 else None
