"""`aira rpc`: calls a service of an agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import click
import msgspec

from mesh.cli.amounts import ETH
from mesh.cli.arguments import request_of, wanted
from mesh.cli.conditions import spoken
from mesh.cli.options import with_settings
from mesh.cli.printing import print_facts, print_json, print_table, say, visible, with_json
from mesh.errors import InputError
from mesh.running import run_to_end
from mesh.settings import NetworkSettings, options_of
from schemas import Record, parse_address
from schemas.logs import LogsRead
from schemas.rpc import GUARDED, SERVICES, Balance, Done, LiabilityRead
from schemas.status import Status

if TYPE_CHECKING:
    from mesh.settings import Settings

ETH_BALANCES: Final = frozenset({"eth/eth_balance", "eth/account_eth_balance"})


@click.command("rpc")
@click.argument("address", required=False)
@click.argument("service", required=False)
@click.argument("arguments", nargs=-1, metavar="[NAME=VALUE … | JSON]")
@click.option("--list", "as_list", is_flag=True, help="list the services, what each is given and what it answers")
@click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    help="seconds to wait for the answer [10, or 240 for what sends a transaction]",
)
@with_json
@with_settings(*options_of(NetworkSettings))
def command(
    settings: Settings,
    address: str | None,
    service: str | None,
    arguments: tuple[str, ...],
    *,
    as_list: bool,
    timeout: float | None,
    as_json: bool,
) -> None:
    """Call SERVICE of the agent with ADDRESS, with arguments by name or as one JSON object:

    aira rpc 0x… start address=0x…

    Amounts are in the smallest unit of the agent's token, which is XRT (wn) unless its settings say otherwise; with
    --json those of ETH are in wei. Agents keep for themselves what signs, sends or spends (marked with * in --list)
    unless their settings open it; one that works by itself keeps start, restart, resume and finish, too.
    """
    if as_list:
        _list(as_json=as_json)
    elif address is None or service is None:
        raise click.UsageError("an ADDRESS and a SERVICE are needed; --list shows the services")
    else:
        run_to_end(lambda: _call(settings, (address, service, arguments), timeout=timeout, as_json=as_json))


def _list(*, as_json: bool) -> None:
    if as_json:
        services = {
            name: {"arguments": wanted(kinds.request), "answer": wanted(kinds.reply), "guarded": name in GUARDED}
            for name, kinds in SERVICES.items()
        }
        print_json(services)
        return
    rows = [
        (f"{name}{'*' if name in GUARDED else ''}", _names(kinds.request, 11), _names(kinds.reply, 4))
        for name, kinds in SERVICES.items()
    ]
    print_table(("service", "arguments", "answer"), rows)


def _names(kind: type[Record], most: int) -> str:
    names = wanted(kind)
    return " ".join(names if len(names) <= most else [*names[:most], "…"]) or "none"


async def _call(
    settings: Settings, called: tuple[str, str, tuple[str, ...]], *, timeout: float | None, as_json: bool
) -> None:
    from mesh.composition import endpoints_of
    from mesh.network import Network, ServiceFailed, call
    from mesh.telemetry.events import human_line

    address, service, arguments = parse_address(called[0]), called[1], called[2]
    request = request_of(service, arguments)
    async with Network(endpoints_of(settings)) as network:
        reply = await call(network.session, address, service, request, timeout=timeout)
    if as_json:
        print_json(msgspec.json.decode(reply.encode()))
    if isinstance(reply, Done) and not reply.success:
        raise ServiceFailed(service, visible(reply.msg) or "it was not done")
    if isinstance(reply, LiabilityRead) and not reply.read:
        raise InputError(f"{getattr(request, 'address', 'it')} is no job of the agent at {address}")
    if isinstance(reply, LogsRead) and not as_json:
        for event in reply.entries:
            say(human_line(event))
    elif not as_json:
        print_facts(_balance_of(service, reply) or _spoken(reply) or {service: "done"})


def _balance_of(service: str, reply: Record) -> dict[str, str]:
    """A balance of ETH. What a token's unit is only the agent knows, so all else is printed as it came."""
    if service in ETH_BALANCES and isinstance(reply, Balance):
        return {"balance": ETH.show(reply.balance)}
    return {}


def _spoken(reply: Record) -> dict[str, str]:
    """The fields of a reply as people read them; those of a record within it stand for that record."""
    if isinstance(reply, Status):
        return spoken(reply)
    told: dict[str, str] = {}
    for field in msgspec.structs.fields(reply):
        value = getattr(reply, field.name)
        if isinstance(value, Record):
            told |= _spoken(value)
        elif value not in (None, ""):
            told[field.encode_name] = _fact(value)
    return told


def _fact(value: object) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case tuple():
            return visible(", ".join(map(str, value))) or "none"
        case int():
            return f"{int(value)}"
    return visible(str(value))
