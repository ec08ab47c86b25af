"""`aira rpc`: calls a service of an agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from mesh.amounts import ETH
from mesh.cli.options import with_json, with_settings, with_timeout
from mesh.cli.output import print_facts, print_json, print_line, print_table, printable
from mesh.cli.status import describe_status
from mesh.errors import InputError, nearest
from mesh.settings import NetworkSettings
from schemas import InvalidRecord, Record, parse_address
from schemas.decoding import InvalidData, decode_json
from schemas.records import UInt256
from schemas.rpc import GUARDED, SERVICES, Balance, Done, LiabilityRead
from schemas.status import LogsRead, Status

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.settings import Settings


BOOLEANS: Final = {"true": True, "yes": True, "false": False, "no": False}
TYPES: Final[Mapping[Any, str]] = {
    UInt256: "a whole number, in the smallest unit",
    bool: "true or false",
    int: "a whole number",
    str: "text",
}
"""How error messages name the values of each type."""


@click.command("rpc")
@click.argument("address", required=False)
@click.argument("service", required=False)
@click.argument("arguments", nargs=-1, metavar="[NAME=VALUE … | JSON]")
@click.option("--list", "as_list", is_flag=True, help="list the services with their arguments and answers")
@with_timeout(None, meaning="seconds to wait for the answer [10; 240 for services that send a transaction]")
@with_json
@with_settings(NetworkSettings)
async def command(
    settings: Settings,
    address: str | None,
    service: str | None,
    arguments: tuple[str, ...],
    *,
    as_list: bool,
    timeout: float | None,
    as_json: bool,
) -> None:
    """Call SERVICE of the agent with ADDRESS. Pass arguments by name or as one JSON object:

    aira rpc 0x… start address=0x…

    Amounts are in the smallest unit of the agent's token, by default XRT (wn). With --json, amounts of ETH are in wei.
    Agents refuse services that sign, send, spend or control them (marked with * in --list) unless open_services is set;
    an agent with an executor also refuses start, restart, resume and finish.
    """
    if as_list:
        _list_services(as_json=as_json)
        return
    if address is None or service is None:
        raise click.UsageError("ADDRESS and SERVICE are required; --list shows the services")
    from mesh.network import Endpoints, Network, ServiceFailed, call
    from mesh.telemetry.logs import human_line

    address, request = parse_address(address), request_of(service, arguments)
    async with Network(Endpoints.from_settings(settings)) as network:
        reply = await call(network.session, address, service, request, timeout=timeout)
    if as_json:
        print_json(decode_json(reply.encode()))
    if isinstance(reply, Done) and not reply.success:
        raise ServiceFailed(f"{service}: {printable(reply.msg) or 'the service failed'}", service=service)
    if isinstance(reply, LiabilityRead) and not reply.read:
        asked = getattr(request, "address", "it")
        raise InputError(f"the agent at {address} has no job for {asked}", code="unknown-job")
    if as_json:
        return
    if isinstance(reply, LogsRead):
        for event in reply.entries:
            print_line(human_line(event))
    elif service in ("eth/eth_balance", "eth/account_eth_balance") and isinstance(reply, Balance):
        print_facts({"balance": ETH.show(reply.balance)})  # only the agent knows the unit of its token
    else:
        print_facts(_describe(reply) or {service: "done"})


def _list_services(*, as_json: bool) -> None:
    if as_json:
        services = {}
        for name, kinds in SERVICES.items():
            takes, answers = argument_names(kinds.request), argument_names(kinds.reply)
            services[name] = {"arguments": takes, "answer": answers, "guarded": name in GUARDED}
        print_json(services)
        return
    rows = [
        (f"{name}{'*' if name in GUARDED else ''}", _names(kinds.request, 11), _names(kinds.reply, 4))
        for name, kinds in SERVICES.items()
    ]
    print_table(("service", "arguments", "answer"), rows)


def _names(kind: type[Record], most: int) -> str:
    names = argument_names(kind)
    return " ".join(names if len(names) <= most else [*names[:most], "…"]) or "none"


def _describe(reply: Record) -> dict[str, str]:
    """The fields of a reply for people; the fields of a nested record are listed among them."""
    if isinstance(reply, Status):
        return describe_status(reply)
    shown: dict[str, str] = {}
    for field in msgspec.structs.fields(reply):
        value = getattr(reply, field.name)
        if isinstance(value, Record):
            shown |= _describe(value)
        elif value not in (None, ""):
            shown[field.encode_name] = _fact(value)
    return shown


def _fact(value: object) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case tuple():
            return printable(", ".join(map(str, value))) or "none"
        case int():
            return f"{int(value)}"
    return printable(str(value))


def argument_names(kind: type[Record]) -> list[str]:
    """The wire names of a record's fields; optional ones are in brackets."""
    return [field.encode_name if field.required else f"[{field.encode_name}]" for field in msgspec.structs.fields(kind)]


def request_of(service: str, arguments: Sequence[str]) -> Record:
    """The request to a service with these arguments. Raises `InputError`."""
    if service not in SERVICES:
        near = nearest(service, SERVICES)
        meant = f"did you mean {near}? " if near else ""
        raise InputError(
            f"there is no service {service[:60]!r}", hint=f"{meant}--list shows all services", code="unknown-service"
        )
    kind = SERVICES[service].request
    given = _given(arguments)
    _check_names(service, kind, given)
    values = {
        field.encode_name: _value(service, field, given[field.encode_name])
        for field in msgspec.structs.fields(kind)
        if field.encode_name in given
    }
    try:
        return kind.decode(msgspec.json.encode(values))
    except InvalidRecord as error:
        raise InputError(f"{service}: {error}", code="invalid-argument") from None


def _given(arguments: Sequence[str]) -> dict[str, Any]:
    """The arguments by name."""
    if len(arguments) == 1 and arguments[0].lstrip().startswith("{"):
        try:
            return decode_json(arguments[0], dict[str, Any])
        except InvalidData as error:
            raise InputError(f"the arguments are not JSON: {error}", code="invalid-argument") from None
    given: dict[str, Any] = {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if not equals or not name:
            raise InputError(
                f"{argument[:60]!r} is not an argument",
                hint="write name=value, or one JSON object",
                code="invalid-argument",
            )
        if name in given:
            raise InputError(f"the argument {name[:60]} is given twice", code="invalid-argument")
        given[name] = value
    return given


def _check_names(service: str, kind: type[Record], given: Mapping[str, Any]) -> None:
    known = [field.encode_name for field in msgspec.structs.fields(kind)]
    takes = f"{service} takes {', '.join(argument_names(kind)) or 'no arguments'}"
    for name in given:
        if name not in known:
            near = nearest(name, known)
            raise InputError(
                f"{service} has no argument {name[:60]!r}",
                hint=f"did you mean {near}? {takes}" if near else takes,
                code="invalid-argument",
            )
    missing = [
        field.encode_name for field in msgspec.structs.fields(kind) if field.required and field.encode_name not in given
    ]
    if missing:
        raise InputError(f"{service} needs {', '.join(missing)}", hint=takes, code="invalid-argument")


def _value(service: str, field: msgspec.structs.FieldInfo, given: Any) -> Any:
    """A value as it is on the wire, where an amount is text; as an argument it may be a number."""
    kind: Any = field.type
    if kind is UInt256 and type(given) is int:
        given = str(given)
    if isinstance(given, str):
        if kind is bool and given.lower() in BOOLEANS:
            return BOOLEANS[given.lower()]
        if kind is int and given.isascii() and given.isdigit():
            return int(given)
        if kind is UInt256 and given.isascii() and given.isdigit():
            return given
    if kind not in TYPES or (type(given) is kind and kind is not UInt256):
        return given
    raise InputError(
        f"{service}: {field.encode_name} is {str(given)[:60]!r}, but must be {TYPES[kind]}", code="invalid-argument"
    )
