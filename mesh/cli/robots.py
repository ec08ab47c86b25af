"""`aira robots`: the robots on a lighthouse's channel, as they present themselves."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click
import msgspec

from mesh.amounts import split_amount
from mesh.cli.chain_client import open_chain
from mesh.cli.files import model_named
from mesh.cli.options import CHAIN_SETTINGS, with_json, with_settings, with_timeout
from mesh.cli.output import format_duration, plural, print_json, print_line, print_table
from mesh.errors import ChainError
from mesh.settings import NetworkSettings
from schemas.address import is_ens_name, parse_address, shortened

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import zenoh

    from mesh.chain import Chain
    from mesh.network import Channel
    from mesh.settings import Settings
    from mesh.watching import Robot


@click.command("robots")
@click.option("--model", help="list only robots of this model: its file, CID or ENS name")
@with_timeout()
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", *CHAIN_SETTINGS)
async def command(settings: Settings, model: str | None, timeout: float, as_json: bool) -> None:
    """List the robots that are present on the lighthouse's channel: name, address, what each is doing, what a job
    costs, and how its latest contracts ended.

    Names, places and prices are the owners' words: anybody may choose any name, so the address says who it is. The
    record counts the contracts of about a week, the 500 latest, that paid the robot or were refunded, also under its
    earlier addresses, which follow; it needs the chain's node, and is left out without one.
    """
    from mesh.role.composition import watching

    named = None if model is None else (await asyncio.to_thread(model_named, model)).name
    async with watching(settings) as (network, channel):
        robots, prices = await _list(settings, network.session, channel, named, timeout=timeout)
    if as_json:
        print_json({"lighthouse": channel.lighthouse, "robots": [msgspec.to_builtins(robot) for robot in robots]})
    elif robots:
        rows = [
            (
                robot.name,
                robot.address,
                doing(robot),
                prices.get(robot.price, robot.price),
                record_of(robot),
                robot.place,
                reads(robot),
            )
            for robot in robots
        ]
        print_table(("name", "address", "doing", "price", "record", "place", "reads"), rows)
    else:
        print_line(f"no robots{' of this model' if named else ''} on {channel.lighthouse}")


async def _list(
    settings: Settings, session: zenoh.Session, channel: Channel, model: str | None, *, timeout: float
) -> tuple[list[Robot], Mapping[str, str]]:
    """The robots with their records, and their prices for people where these name a token by its address.

    As far as the node answers. Raises `UnknownName` and its like for a model.
    """
    from mesh.watching import RobotDirectory

    directory = RobotDirectory(session, channel)
    if model is not None and is_ens_name(model):
        async with open_chain(settings) as chain:
            model = await chain.names.model(model)
    robots = await directory.present(model or "", timeout=timeout)
    try:
        async with open_chain(settings) as chain:
            return await directory.count(chain, robots), await _prices(chain, robots)
    except ChainError as error:
        click.echo(f"aira: no records: {error}", err=True)
        return robots, {}


async def _prices(chain: Chain, robots: Iterable[Robot]) -> Mapping[str, str]:
    """Prices that name a token by its address, as amounts of it, by what the robots say."""
    stated = {robot.price: split_amount(robot.price) for robot in robots if " 0x" in robot.price}
    units = await chain.tokens.units(parse_address(token.lower()) for _, token in stated.values())
    tokens = {price: units[parse_address(token.lower())] for price, (_, token) in stated.items()}
    return {price: f"{number} {tokens[price].symbol}" for price, (number, _) in stated.items()}


def doing(robot: Robot) -> str:
    """What a robot is doing, and how long a new job would wait, for people."""
    words: list[str] = [robot.state]
    if robot.queue:
        words.append(f"{plural(robot.queue, 'job')} wait{'s' if robot.queue == 1 else ''}")
    if robot.wait:
        words.append(f"about {format_duration(robot.wait * 10**9)}")
    return ", ".join(words)


def reads(robot: Robot) -> str:
    """What a robot reads just now, for people."""
    return ", ".join(f"{topic} {text}" for topic, text in robot.readings.items())


def record_of(robot: Robot) -> str:
    """How a robot's latest contracts ended, and under which earlier addresses, for people."""
    known = robot.paid is not None and robot.refunded is not None
    record = f"{robot.paid:,} paid, {robot.refunded:,} refunded" if known else "unknown"
    return f"{record}, formerly {', '.join(map(shortened, robot.formerly))}" if robot.formerly else record
