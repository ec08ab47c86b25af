"""`aira robots`: the robots on a lighthouse's channel, as they present themselves; `aira quotes`: what they want for a
job, before it is ordered.
"""

from __future__ import annotations

import asyncio
import json
import shlex
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click
import msgspec

from mesh.amounts import split_amount
from mesh.cli.chain_client import open_chain
from mesh.cli.files import FETCH_SETTINGS, model_named, objective_given, objective_of, opened_store
from mesh.cli.options import CHAIN_SETTINGS, with_json, with_objective, with_settings, with_timeout
from mesh.cli.output import format_duration, plural, print_facts, print_json, print_line, print_table, printable
from mesh.errors import ChainError
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from mesh.watching.robots import labelled
from schemas.address import is_ens_name, parse_address, shortened
from schemas.decoding import decode_json
from schemas.model import InvalidDescription, ValueSchema

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import zenoh

    from mesh.agent.agent import Messages
    from mesh.amounts import Unit
    from mesh.chain import Chain
    from mesh.network import Channel
    from mesh.settings import Settings
    from mesh.watching import Robot
    from schemas.model import ModelDescription, ModelTopic
    from schemas.rpc import Quote


@click.command("robots")
@click.argument("robot", required=False)
@click.option("--model", help="list only robots of this model: its file, CID or ENS name")
@with_timeout()
@with_json
@with_settings(*FETCH_SETTINGS, "lighthouse_contract", *CHAIN_SETTINGS)
async def command(settings: Settings, robot: str | None, model: str | None, timeout: float, as_json: bool) -> None:
    """List the robots that are present on the lighthouse's channel: name, address, what each does and is doing, what a
    job costs, and how its latest contracts ended. With ROBOT, a name or an address, show that one with all that can be
    ordered of it, and the command that orders it.

    Names, places and prices are the owners' words: anybody may choose any name, so the address says who it is. The
    record counts the contracts of about a week, the 500 latest, that paid the robot or were refunded, also under its
    earlier addresses, which follow; it needs the chain's node, and is left out without one.
    """
    from mesh.role.composition import watching

    named = None if model is None else (await asyncio.to_thread(model_named, model)).name
    async with watching(settings) as (network, channel):
        robots, prices = await _list(settings, network.session, channel, robot, named, timeout=timeout)
        models = await _descriptions(settings, network.session, {one.model for one in robots} - {""})
    if as_json:
        print_json({"lighthouse": channel.lighthouse, "robots": [msgspec.to_builtins(one) for one in robots]})
    elif robot is not None:
        for one in robots:
            _print_robot(one, models.get(one.model), prices.get(one.price, one.price))
    elif robots:
        rows = [
            (
                one.name,
                one.address,
                models[one.model].title if one.model in models else "",
                doing(one),
                prices.get(one.price, one.price),
                record_of(one),
                one.place,
                reads(one),
            )
            for one in robots
        ]
        print_table(("name", "address", "does", "now", "price", "record", "place", "reads"), rows)
    else:
        print_line(f"no robots{' of this model' if named else ''} on {channel.lighthouse}")


async def _list(
    settings: Settings,
    session: zenoh.Session,
    channel: Channel,
    named: str | None,
    model: str | None,
    *,
    timeout: float,
) -> tuple[list[Robot], Mapping[str, str]]:
    """The robots, or the one that is named, with their records, and their prices where these name a token by its
    address, for people.

    As far as the node answers. Raises `UnknownName` and its like for a model, and as `RobotDirectory.named`.
    """
    from mesh.watching import RobotDirectory

    directory = RobotDirectory(session, channel)
    if model is not None and is_ens_name(model):
        async with open_chain(settings) as chain:
            model = await chain.names.model(model)
    robots = (
        await directory.present(model or "", timeout=timeout)
        if named is None
        else [await directory.named(named, model=model or "", timeout=timeout)]
    )
    try:
        async with open_chain(settings) as chain:
            return await directory.count(chain, robots), await _prices(chain, robots)
    except ChainError as error:
        click.echo(f"aira: no records: {error}", err=True)
        return robots, {}


async def _descriptions(
    settings: Settings, session: zenoh.Session, models: Iterable[str]
) -> Mapping[str, ModelDescription]:
    """The descriptions of models, by CID, as far as the store has them or somebody serves them now."""
    from mesh.content import Exchange
    from mesh.role.models import Models

    found = {}
    async with opened_store(settings) as store, Exchange(session, store) as exchange:
        known = Models(store, exchange)
        for cid in sorted(models)[:32]:
            with suppress(InvalidDescription):
                if (description := await known.find(cid)) is not None:
                    found[cid] = description
    return found


def _print_robot(robot: Robot, model: ModelDescription | None, price: str) -> None:
    """A robot, what can be ordered of it, and how, for people."""
    from mesh.cli.model import print_description

    print_facts(
        {
            "robot": robot.name or None,
            "address": robot.address,
            "about": robot.about or None,
            "now": doing(robot),
            "price": price or None,
            "record": record_of(robot),
            "place": robot.place or None,
            "reads": reads(robot) or None,
        }
    )
    if model is None:
        print_line(f"\nmodel {robot.model or 'none'}, which nobody here describes")
        return
    print_line("")
    print_description(model)
    if model.objective:
        topics = [topic for topic in model.objective if topic.required] or list(model.objective[:1])
        messages = " ".join(f"--message {shlex.quote(message_like(topic))}" for topic in topics)
        cost = f" --cost {shlex.quote(robot.price)}" if robot.price else ""
        print_line(f"\nto order it:  aira demand --robot {robot.address}{cost} {messages}")


def message_like(topic: ModelTopic) -> str:
    """A message that a topic allows, as `--message` takes it: defaults, or the least that is required."""
    value = None if topic.value is None else example(topic.value)
    return topic.topic if value is None else f"{topic.topic} {json.dumps(value, ensure_ascii=False)}"


def example(schema: ValueSchema) -> Any:
    """A value that a schema allows."""
    if schema.default is not None:
        return schema.default
    if schema.enum:
        return schema.enum[0]
    match schema.type:
        case "object":
            return {name: example(schema.properties[name]) for name in schema.required if name in schema.properties}
        case "array":
            return [example(schema.items or ValueSchema())] * (schema.min_items or 0)
        case "string":
            return "x" * (schema.min_length or 0)
        case "boolean":
            return True
        case "integer" | "number":
            return _number_like(schema)
    return None


def _number_like(schema: ValueSchema) -> float:
    if schema.minimum is not None:
        return schema.minimum
    if schema.exclusive_minimum is not None:
        above = schema.exclusive_minimum + 1
        most = schema.maximum if schema.exclusive_maximum is None else schema.exclusive_maximum
        return above if most is None or above < most else (schema.exclusive_minimum + most) / 2
    least = [0, schema.maximum, None if schema.exclusive_maximum is None else schema.exclusive_maximum - 1]
    return min(number for number in least if number is not None)


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


@click.command("quotes")
@click.option("--model", required=True, help="model of the robots: its file, CID or ENS name")
@with_objective
@with_timeout()
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", "erc20_token", AccountSettings, ChainSettings)
async def quotes(
    settings: Settings, model: str, objective: str | None, messages: Messages, timeout: float, as_json: bool
) -> None:
    """Ask the robots of a model what they want for a job, when they would begin, and how long it takes.

    The cheapest is listed first, of each token that robots want to be paid in; those that want the token of the
    settings come first. A robot that does not want the job says why. Nothing is ordered, and nobody is bound: `aira
    demand --robot NAME|ADDRESS|cheapest|first` orders.
    """
    from mesh.agent.agent import Agent

    named = await asyncio.to_thread(model_named, model)
    given = await asyncio.to_thread(objective_given, objective, messages)
    settings.keyfile_and_password()
    async with Agent(named.name, settings=replace(settings, metrics_listen="")) as agent:
        found = await agent.quotes(agent.model, await objective_of(agent, given), timeout=timeout)
        units = await agent.parts.chain.tokens.units(quote.token for quote in found if quote.token)
        names = {quote.agent: agent.parts.robots.name(quote.agent) for quote in found}
    if as_json:
        print_json({"quotes": [decode_json(quote.encode()) | {"name": names[quote.agent]} for quote in found]})
    elif found:
        offers = [(*_offered(quote, units), names[quote.agent], quote.agent) for quote in found if not quote.code]
        if offers:
            print_table(("cost", "begins", "takes", "name", "address"), offers)
        for quote in (quote for quote in found if quote.code):
            why = f"{printable(quote.detail)} ({printable(quote.code)})".lstrip()
            print_line(f"{labelled(quote.agent, names[quote.agent])} declines: {why}")
    else:
        print_line("no robot of this model answers")


def _offered(quote: Quote, units: Mapping[str, Unit]) -> tuple[str, str, str]:
    """What a robot wants, when it would begin, and how long it takes, for people."""
    begins = f"in {format_duration(round(quote.start * 1e9))}" if quote.start else "now"
    cost = units[quote.token].show(quote.cost)
    return cost, begins, format_duration(round(quote.seconds * 1e9)) if quote.seconds else "unknown"
