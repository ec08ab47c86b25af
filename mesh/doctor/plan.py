"""Which checks a case needs, in the order in which they are told."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Final

from mesh.doctor.checks import Check, aside
from mesh.doctor.findings import of_error
from mesh.errors import AiraError, ConfigurationError
from mesh.settings import DEFAULTS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from mesh.doctor.case import Case
    from mesh.doctor.chain import Ledgers
    from mesh.doctor.findings import Finding

ELSEWHERE: Final = {"ipfs": "bridges.ipfs.check", "serial": "bridges.serial.check"}
"""Modules of other worlds whose `checks(case)` are loaded by name, as imports go the other way."""


class NoRouter(ConfigurationError):
    """The settings name no router, or of a router nowhere to listen."""

    code = "no-router"

    def __init__(self, role: str) -> None:
        option = "--listen" if role == "router" else "--connect"
        super().__init__("the settings name no router", hint=f"give {option} tcp/127.0.0.1:7447, or another address")


@asynccontextmanager
async def checks_for(case: Case) -> AsyncIterator[list[Check]]:
    """The checks of a case, to be made before this ends: it closes what they have opened."""
    fields = case.fields
    async with AsyncExitStack() as stack:
        checks: list[Check] = []
        if "roster" in fields:
            checks.append(_roster(case))
        checks += _network(case, stack)
        if "chain" in fields:
            checks += _guarded("node", partial(_chain, case, stack))
        if "disk" in fields:
            checks += _disk(case)
        for field, module in ELSEWHERE.items():
            if field in fields:
                checks += _guarded(field, partial(_elsewhere, module, case))
        yield checks


def _guarded(name: str, plan: Callable[[], list[Check]]) -> list[Check]:
    """The checks of a field, or one that says why there are none: a package is missing, a setting can't be meant."""
    try:
        return plan()
    except (AiraError, ModuleNotFoundError) as error:
        return [Check(name, partial(_raise, error))]


async def _raise(error: Exception) -> Finding:
    raise error


def _roster(case: Case) -> Check:
    from mesh.doctor.roster import look_at_roster

    return Check("roster", partial(aside, look_at_roster, case))


def _network(case: Case, stack: AsyncExitStack) -> list[Check]:
    from mesh.doctor.endpoints import is_everywhere, look_at, look_at_certificate

    if not case.connect:
        return [Check("router", partial(_raise, NoRouter(case.role)))]
    certificate = [Check("certificate", partial(aside, look_at_certificate, case))] if case.has_identity else []
    needs = _each(*certificate)
    routers = [Check("router", partial(aside, look_at, locator, case.settings), needs) for locator in case.connect]
    sessions: list[Check] = []
    for locator, router in zip(case.connect, routers, strict=True):
        if is_everywhere(locator):
            continue  # Zenoh opens none to a host that the certificate does not name
        sessions += _at_router(case, locator, needs=(*needs, (router,)), stack=stack)
    return [*certificate, *routers, *sessions]


def _at_router(case: Case, locator: str, *, needs: tuple[tuple[Check, ...], ...], stack: AsyncExitStack) -> list[Check]:
    """What is tried at one router; where there are several, each says which it is."""
    from mesh.doctor.network import Wire

    wire = Wire(case, locator, stack)
    label = f"{locator}: " if len(case.connect) > 1 else ""
    session = Check("session", partial(_labelled, label, wire.check_session), needs)
    if case.role == "router":  # what it may do elsewhere is for the routers to which it links
        return [session]
    own = Check("own write", partial(_labelled, label, wire.check_own_write), _each(session))
    denied = Check("denied write", partial(_labelled, label, wire.check_denied_write), _each(own))
    return [session, own, denied, Check("router clock", partial(_labelled, label, wire.check_clock), _each(own))]


async def _labelled(label: str, make: Callable[[], Awaitable[Finding]]) -> Finding:
    """What is found, said of something in particular."""
    try:
        finding = await make()
    except AiraError as error:
        finding = of_error(error)
    return finding._replace(found=f"{label}{finding.found}")


def _chain(case: Case, stack: AsyncExitStack) -> list[Check]:
    from mesh.doctor.chain import Ledgers, check_node_clock, nodes_of

    settings = case.settings
    ledgers = Ledgers(settings, stack, expected=case.chain_id)
    nodes = [Check("node", partial(ledgers.check_node, endpoint)) for endpoint in nodes_of(settings)]
    chain = Check("chain", ledgers.check_chain, needs=(tuple(nodes),))
    clocks = [
        Check("node clock", partial(check_node_clock, endpoint), needs=_each(node))
        for endpoint, node in zip(nodes_of(settings), nodes, strict=True)
        if endpoint.startswith("http")
    ]
    contracts = Check("contracts", ledgers.check_contracts, needs=_each(chain))
    on_chain = [
        Check("lighthouse", ledgers.check_lighthouse, needs=_each(contracts)),
        Check("token", ledgers.check_token, needs=_each(contracts)),
    ]
    clock = Check("chain clock", ledgers.check_clock, needs=_each(chain))
    money = _account(case, ledgers, chain, contracts) if "account" in case.fields else []
    return [*nodes, *_sockets(case, ledgers), chain, *clocks, clock, contracts, *on_chain, *money]


def _sockets(case: Case, ledgers: Ledgers) -> list[Check]:
    """The websocket, where one was named."""
    named = case.settings.web3_ws_provider.strip()
    if named in ("", DEFAULTS.web3_ws_provider) or not case.settings.web3_http_provider.strip():
        return []
    return [Check("websocket", partial(ledgers.check_node, named))]


def _account(case: Case, ledgers: Ledgers, chain: Check, contracts: Check) -> list[Check]:
    from mesh.doctor.account import Purse

    if case.keyfile is None and case.asked_role is None:
        return []  # who only looks on has none
    purse = Purse(case, ledgers)
    keyfile = Check("keyfile", purse.check_keyfile)
    money = [
        keyfile,
        Check("ether", purse.check_ether, needs=_each(keyfile, chain)),
        Check("tokens", purse.check_tokens, needs=_each(keyfile, contracts)),
    ]
    if "spending" in case.fields:
        money.append(Check("allowance", purse.check_allowance, needs=_each(keyfile, contracts)))
    if "stake" in case.fields:
        stake = Check("stake", purse.check_stake, needs=_each(keyfile, contracts))
        money += [stake, Check("turn", purse.check_turn, needs=_each(stake))]
    return money


def _disk(case: Case) -> list[Check]:
    from mesh.doctor.disk import look_at_folder, look_at_room

    folder = case.settings.state_directory
    written = Check("data folder", partial(aside, look_at_folder, folder))
    room = partial(look_at_room, folder, content_limit=case.settings.content_limit)
    return [written, Check("disk space", partial(aside, room), needs=_each(written))]


def _elsewhere(module: str, case: Case) -> list[Check]:
    found: list[Check] = import_module(module).checks(case)
    return found


def _each(*checks: Check) -> tuple[tuple[Check, ...], ...]:
    """All of these must be in order."""
    return tuple((check,) for check in checks)
