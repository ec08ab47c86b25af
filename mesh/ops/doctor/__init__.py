"""`aira doctor`: checks whether this machine can run a role, and suggests a fix for each problem.

Here is which checks run for a role, in the order in which they are reported.

Checks of other packages are entry points of the group `aira.doctor_checks`. An entry point's name is the role that
needs the checks; its object is a function that takes the `DoctorContext` and returns a list of `Check`s.
"""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError, ConfigurationError
from mesh.ops.doctor._machine import (
    check_certificate,
    check_data_folder,
    check_descriptors,
    check_disk_space,
    check_roster,
    check_router_address,
    is_everywhere,
)
from mesh.ops.doctor.checks import (
    Check,
    CheckResult,
    CheckStatus,
    DoctorContext,
    failed,
    from_error,
    in_thread,
    passed,
    run_checks,
    warning,
)
from mesh.settings import DEFAULTS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from importlib.metadata import EntryPoint

    from mesh.ops.doctor._chain import ChainChecks

ENTRY_POINTS: Final = "aira.doctor_checks"


@asynccontextmanager
async def checks_for(context: DoctorContext) -> AsyncIterator[list[Check]]:
    """The checks for a context. Run them inside the block: leaving it closes what they opened."""
    areas = context.areas
    async with AsyncExitStack() as stack:
        checks: list[Check] = []
        if "roster" in areas:
            checks.append(Check("roster", partial(in_thread, check_roster, context)))
        if context.role == "router":
            checks.append(Check("descriptors", partial(in_thread, check_descriptors, context.settings.max_sessions)))
        checks += _network_checks(context, stack)
        if "chain" in areas:
            checks += _or_reason("node", partial(_chain_checks, context, stack))
        if "disk" in areas:
            folder = context.settings.state_directory
            written = Check("data folder", partial(in_thread, check_data_folder, folder))
            space = partial(check_disk_space, folder, content_limit=context.settings.content_limit)
            checks += [written, Check("disk space", partial(in_thread, space), needs=_all_of(written))]
        checks += _registered_checks(context)
        yield checks


def _registered_checks(context: DoctorContext) -> list[Check]:
    """The checks of other packages for the context's roles. Only their modules are imported."""
    from importlib.metadata import entry_points

    def load(entry: EntryPoint) -> list[Check]:
        return list(entry.load()(context))

    found = sorted({entry for entry in entry_points(group=ENTRY_POINTS) if entry.name in context.roles})
    return [
        check
        for entry in found
        for check in _or_reason(entry.module.rpartition(".")[0].rpartition(".")[2] or entry.name, partial(load, entry))
    ]


def _or_reason(name: str, collect: Callable[[], list[Check]]) -> list[Check]:
    """These checks, or one failed check if a package is missing or a setting unusable."""
    try:
        return collect()
    except (AiraError, ModuleNotFoundError) as error:
        return [Check(name, partial(_raise, error))]


async def _raise(error: Exception) -> CheckResult:
    raise error


def _network_checks(context: DoctorContext, stack: AsyncExitStack) -> list[Check]:
    if not context.connect:
        option = "--listen" if context.role == "router" else "--connect"
        hint = f"give {option}, such as {option} tcp/127.0.0.1:7447"
        error = ConfigurationError("the settings name no router", hint=hint, code="router-missing")
        return [Check("router", partial(_raise, error))]
    certificate = [Check("certificate", partial(in_thread, check_certificate, context))] if context.has_identity else []
    needs = _all_of(*certificate)
    routers = [
        Check("router", partial(in_thread, check_router_address, locator, context.settings), needs)
        for locator in context.connect
    ]
    sessions: list[Check] = []
    for locator, router in zip(context.connect, routers, strict=True):
        if is_everywhere(locator):
            continue  # Zenoh opens no session to a host that is not in the certificate
        sessions += _session_checks(context, locator, needs=(*needs, (router,)), stack=stack)
    return [*certificate, *routers, *sessions]


def _session_checks(
    context: DoctorContext, locator: str, *, needs: tuple[tuple[Check, ...], ...], stack: AsyncExitStack
) -> list[Check]:
    """The checks at one router; if there are several, each result names its router."""
    from mesh.ops.doctor._session import SessionChecks

    checks = SessionChecks(context, locator, stack)
    label = f"{locator}: " if len(context.connect) > 1 else ""
    session = Check("session", partial(_labelled, label, checks.check_session), needs)
    if context.role == "router":  # the routers that it links to decide about its rights there
        return [session]
    own = Check("own write", partial(_labelled, label, checks.check_own_write), _all_of(session))
    denied = Check("denied write", partial(_labelled, label, checks.check_denied_write), _all_of(own))
    return [session, own, denied, Check("router clock", partial(_labelled, label, checks.check_clock), _all_of(own))]


async def _labelled(label: str, run: Callable[[], Awaitable[CheckResult]]) -> CheckResult:
    """The result with a label before its message."""
    try:
        result = await run()
    except AiraError as error:
        result = from_error(error)
    return result._replace(message=f"{label}{result.message}")


def _chain_checks(context: DoctorContext, stack: AsyncExitStack) -> list[Check]:
    from mesh.ops.doctor._chain import ChainChecks, check_node_clock, nodes_of

    settings = context.settings
    checks = ChainChecks(settings, stack, expected=context.chain_id)
    nodes = [Check("node", partial(checks.check_node, endpoint)) for endpoint in nodes_of(settings)]
    chain = Check("chain", checks.check_chain, needs=(tuple(nodes),))
    profile = Check("chain profile", checks.check_profile, needs=_all_of(chain))
    clocks = [
        Check("node clock", partial(check_node_clock, endpoint), needs=_all_of(node))
        for endpoint, node in zip(nodes_of(settings), nodes, strict=True)
        if endpoint.startswith("http")
    ]
    contracts = Check("contracts", checks.check_contracts, needs=_all_of(chain))
    on_chain = [
        Check("lighthouse", checks.check_lighthouse, needs=_all_of(contracts)),
        Check("token", checks.check_token, needs=_all_of(contracts)),
    ]
    clock = Check("chain clock", checks.check_clock, needs=_all_of(chain))
    money = _account_checks(context, checks, chain, contracts) if "account" in context.areas else []
    socket = settings.web3_ws_provider.strip()
    is_given = socket not in ("", DEFAULTS.web3_ws_provider) and settings.web3_http_provider.strip()
    sockets = [Check("websocket", partial(checks.check_node, socket))] if is_given else []
    return [*nodes, *sockets, chain, profile, *clocks, clock, contracts, *on_chain, *money]


def _account_checks(context: DoctorContext, chain_checks: ChainChecks, chain: Check, contracts: Check) -> list[Check]:
    from mesh.ops.doctor._chain import AccountChecks

    if context.keyfile is None and context.requested_role is None:
        return []  # an agent that only watches has no account
    account = AccountChecks(context, chain_checks)
    keyfile = Check("keyfile", account.check_keyfile)
    money = [
        keyfile,
        Check("ether", account.check_ether, needs=_all_of(keyfile, chain)),
        Check("tokens", account.check_tokens, needs=_all_of(keyfile, contracts)),
        Check("other allowances", account.check_other_allowances, needs=_all_of(keyfile, contracts)),
    ]
    if "spending" in context.areas:
        money.append(Check("allowance", account.check_allowance, needs=_all_of(keyfile, contracts)))
    if "judging" in context.areas:
        money.append(Check("validator", account.check_validator, needs=_all_of(keyfile, contracts)))
    if "stake" in context.areas:
        stake = Check("stake", account.check_stake, needs=_all_of(keyfile, contracts))
        money += [stake, Check("turn", account.check_turn, needs=_all_of(stake))]
    return money


def _all_of(*checks: Check) -> tuple[tuple[Check, ...], ...]:
    """`needs` that require every one of these checks."""
    return tuple((check,) for check in checks)
