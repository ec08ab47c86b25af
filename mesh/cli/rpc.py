"""`aira rpc`: calls a service of an agent."""

from __future__ import annotations

import difflib
import json
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from mesh.cli.amounts import ETH
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import print_facts, print_json, print_line, print_table, printable
from mesh.cli.status import spoken
from mesh.errors import InputError
from mesh.running import run_to_end
from mesh.settings import NetworkSettings, options_of
from schemas import InvalidRecord, Record, parse_address
from schemas.logs import LogsRead
from schemas.records import UInt256
from schemas.rpc import GUARDED, SERVICES, Balance, Done, LiabilityRead
from schemas.status import Status

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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
        _list_services(as_json=as_json)
    elif address is None or service is None:
        raise click.UsageError("an ADDRESS and a SERVICE are needed; --list shows the services")
    else:
        run_to_end(lambda: _call(settings, (address, service, arguments), timeout=timeout, as_json=as_json))


def _list_services(*, as_json: bool) -> None:
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
        raise ServiceFailed(service, printable(reply.msg) or "it was not done")
    if isinstance(reply, LiabilityRead) and not reply.read:
        raise InputError(f"{getattr(request, 'address', 'it')} is no job of the agent at {address}")
    if isinstance(reply, LogsRead) and not as_json:
        for event in reply.entries:
            print_line(human_line(event))
    elif not as_json:
        print_facts(_balance_of(service, reply) or _describe(reply) or {service: "done"})


def _balance_of(service: str, reply: Record) -> dict[str, str]:
    """A balance of ETH. What a token's unit is only the agent knows, so all else is printed as it came."""
    if service in ETH_BALANCES and isinstance(reply, Balance):
        return {"balance": ETH.show(reply.balance)}
    return {}


def _describe(reply: Record) -> dict[str, str]:
    """The fields of a reply as people read them; those of a record within it stand for that record."""
    if isinstance(reply, Status):
        return spoken(reply)
    told: dict[str, str] = {}
    for field in msgspec.structs.fields(reply):
        value = getattr(reply, field.name)
        if isinstance(value, Record):
            told |= _describe(value)
        elif value not in (None, ""):
            told[field.encode_name] = _fact(value)
    return told


def _fact(value: object) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case tuple():
            return printable(", ".join(map(str, value))) or "none"
        case int():
            return f"{int(value)}"
    return printable(str(value))


TRUTHS: Final = {"true": True, "yes": True, "false": False, "no": False}


KINDS: Final[Mapping[Any, str]] = {
    UInt256: "a whole number, in the smallest unit",
    bool: "true or false",
    int: "a whole number",
    str: "text",
}
"""What is to be written for a value that is not any text."""


def wanted(kind: type[Record]) -> list[str]:
    """The names of a record's fields as they travel; those that may be left out are in brackets."""
    return [field.encode_name if field.required else f"[{field.encode_name}]" for field in _fields(kind)]


def request_of(service: str, arguments: Sequence[str]) -> Record:
    """The request to a service with these arguments.

    Raises `InputError`, which says what is missing, unknown or of another kind.
    """
    if service not in SERVICES:
        near = difflib.get_close_matches(service, SERVICES, n=1, cutoff=0)[0]
        raise InputError(f"there is no service {service[:60]!r}", hint=f"did you mean {near}? --list shows all")
    kind = SERVICES[service].request
    given = _given(arguments)
    _check_names(service, kind, given)
    values = {field.encode_name: _value(service, field, given[field.encode_name]) for field in _named(kind, given)}
    try:
        return kind.decode(msgspec.json.encode(values))
    except InvalidRecord as error:
        raise InputError(f"{service}: {error}") from None


def _given(arguments: Sequence[str]) -> dict[str, Any]:
    """What was typed, by name."""
    if len(arguments) == 1 and arguments[0].lstrip().startswith("{"):
        try:
            found = json.loads(arguments[0])
        except (ValueError, RecursionError) as error:
            raise InputError(f"the arguments are not JSON: {error}") from None
        assert isinstance(found, dict)
        return found
    given: dict[str, Any] = {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if not equals or not name:
            raise InputError(f"{argument[:60]!r} is no argument", hint="write name=value, or one JSON object")
        if name in given:
            raise InputError(f"{name[:60]} is given twice")
        given[name] = value
    return given


def _check_names(service: str, kind: type[Record], given: Mapping[str, Any]) -> None:
    known = [field.encode_name for field in _fields(kind)]
    takes = f"{service} takes {', '.join(wanted(kind)) or 'no arguments'}"
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            raise InputError(
                f"{service} has no argument {name[:60]!r}", hint=f"did you mean {near[0]}? {takes}" if near else takes
            )
    missing = [field.encode_name for field in _fields(kind) if field.required and field.encode_name not in given]
    if missing:
        raise InputError(f"{service} needs {', '.join(missing)}", hint=takes)


def _value(service: str, field: msgspec.structs.FieldInfo, given: Any) -> Any:
    """A value as it travels. In JSON an amount may be a number, though it travels as text."""
    kind: Any = field.type
    if kind is UInt256 and type(given) is int:
        given = str(given)
    if isinstance(given, str):
        if kind is bool and given.lower() in TRUTHS:
            return TRUTHS[given.lower()]
        if kind is int and given.isascii() and given.isdigit():
            return int(given)
        if kind is UInt256 and given.isascii() and given.isdigit():
            return given
    if kind not in KINDS or (type(given) is kind and kind is not UInt256):
        return given
    raise InputError(f"{service}: {field.encode_name} is {str(given)[:60]!r}, and has to be {KINDS[kind]}")


def _fields(kind: type[Record]) -> tuple[msgspec.structs.FieldInfo, ...]:
    return msgspec.structs.fields(kind)


def _named(kind: type[Record], given: Mapping[str, Any]) -> list[msgspec.structs.FieldInfo]:
    return [field for field in _fields(kind) if field.encode_name in given]
