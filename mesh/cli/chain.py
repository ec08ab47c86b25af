"""`aira chain`: the network's contracts on a chain, and a chain for development."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import XRT, Unit
from mesh.cli.chain_client import READ_ATTEMPTS, open_chain, own_address
from mesh.cli.lazy import LazyGroup
from mesh.cli.lighthouse import check_lighthouse
from mesh.cli.options import with_chain_settings, with_json, with_lighthouse_options, with_signing_settings
from mesh.cli.output import print_line, print_result, printable
from mesh.errors import ChainError, ConfigurationError

if TYPE_CHECKING:
    from mesh.chain import Account, Chain, Deployment, Node
    from mesh.settings import Settings


REFUND_SECONDS: Final = 7 * 86_400
"""After which a job that nobody finished can be refunded, by default."""
DEPLOYMENT_GAS: Final = 13_000_000
"""Slightly more than a whole deployment uses where it costs most: 9.9 million today, a fifth more on geth's next fork.
An account that can't pay for it is rejected at the start."""


command = LazyGroup(
    "chain",
    help="Run a development chain; deploy and inspect the network's contracts on any chain.",
    lazy={
        "cost": ("mesh.cli.chain_cost:cost", "show what a job costs, in the chain's coin and in money"),
        "up": ("mesh.cli.up:chain_up", "serve a development chain with the contracts"),
    },
)


@command.command("deploy", short_help="deploy the contracts to a chain")
@click.option("--lighthouse", default="airalab", show_default=True, help="name of the first lighthouse (one ENS label)")
@with_lighthouse_options
@click.option(
    "--refund-delay",
    type=click.IntRange(1, 2**32 - 1),
    default=None,
    help="blocks until the cost of an unfinished job can be refunded; can't be changed later [a week of the chain's"
    " blocks; 50400 if none is named]",
)
@click.option(
    "--emission-percent",
    type=click.IntRange(1, 10_000),
    default=100,
    show_default=True,
    help="wn that providers are minted for 100 units of gas; more where the chain's fork makes work take more gas;"
    " can't be changed later",
)
@click.option("--again", is_flag=True, help="deploy even if the chain already has the contracts; the old ones stay")
@with_json
@with_signing_settings()
async def deploy_contracts(
    settings: Settings,
    *,
    lighthouse: str,
    minimal_stake: str,
    timeout_blocks: int,
    refund_delay: int | None,
    emission_percent: int,
    again: bool,
    as_json: bool,
) -> None:
    """Deploy the contracts: ENS registry and names, XRT, factory, and a first lighthouse.

    The settings' account pays the gas, owns the names and receives the first million XRT. Sends about twenty
    transactions, one after another, and prints the settings that use the contracts. A deployment that was interrupted
    is continued when the same is called again.
    """
    from mesh.chain import DeploymentPlan, deploy
    from mesh.chain.deploy import check_evm, interrupted_deployment
    from mesh.role.composition import chain_of, load_account

    plan = DeploymentPlan(
        lighthouse=lighthouse,
        minimal_stake=XRT.parse(minimal_stake),
        timeout_blocks=timeout_blocks,
        refund_delay=refund_delay or settings.profile.blocks_in(REFUND_SECONDS),
        emission_percent=emission_percent,
    )
    check_lighthouse(plan.lighthouse, minimal_stake=plan.minimal_stake)  # it is created last, too late for an error
    account = await asyncio.to_thread(load_account, settings)
    node = chain_of(settings, account).node
    async with node:
        await check_evm(node)
        found = await interrupted_deployment(node, account.address, plan)
        if found:  # what is left of it costs less
            click.echo(f"continuing a deployment that was interrupted: {', '.join(found.values())}", err=True)
        else:
            if not again:
                await _check_not_deployed(settings, node)
            await _check_affordable(node, account)
        if not as_json:
            click.echo(f"deploying to the chain {node.chain_id} at {node.endpoint} with {account.address}:", err=True)
            click.echo("about twenty transactions, one after another", err=True)
        deployment = await deploy(node, account, plan=plan)
        _print_deployment(settings, deployment, chain_id=node.chain_id, as_json=as_json)


async def _check_not_deployed(settings: Settings, node: Node) -> None:
    from mesh.chain import NoContracts
    from mesh.role.composition import chain_of

    try:
        async with chain_of(settings, None) as chain:
            raise ConfigurationError(
                f"the chain {node.chain_id} already has the contracts (factory {chain.factory})",
                hint="use them, or deploy a second set with --again; for another lighthouse: `aira lighthouse create`",
                code="already-deployed",
            )
    except NoContracts:
        return


async def _check_affordable(node: Node, account: Account) -> None:
    from mesh.chain import InsufficientFunds

    balance = await node.eth_balance(account.address)
    needed = DEPLOYMENT_GAS * await node.gas_price()
    if balance < needed:
        raise InsufficientFunds(account.address, balance=balance, needed=needed)


def _print_deployment(settings: Settings, deployment: Deployment, *, chain_id: int, as_json: bool) -> None:
    named = {"chain": settings.chain} if settings.chain else {}
    options = named | {
        "web3_http_provider": settings.web3_http_provider,
        "ens_contract": deployment.ens,
        "lighthouse_contract": deployment.lighthouse_name,
    }
    result = {
        "chainId": chain_id,
        "ens": deployment.ens,
        "resolver": deployment.resolver,
        "xrt": deployment.xrt,
        "factory": deployment.factory,
        "lighthouse": deployment.lighthouse,
        "lighthouseName": deployment.lighthouse_name,
        "blockNumber": deployment.block_number,
        "gasUsed": deployment.gas_used,
        "settings": options,
    }
    facts = {
        "ENS registry": deployment.ens,
        "resolver": deployment.resolver,
        "XRT": deployment.xrt,
        "factory": deployment.factory,
        "lighthouse": f"{deployment.lighthouse}  {deployment.lighthouse_name}",
        "block": f"{deployment.block_number:,}",
        "gas used": f"{deployment.gas_used:,}",
    }
    print_result(result, facts, as_json=as_json)
    if not as_json:
        print_line("\nsettings to use these contracts:\n")
        for name, value in options.items():
            print_line(f'{name} = "{value}"')


MEASURED: Final = 200
"""Blocks between which their pace is measured."""
GWEI: Final = Unit("gwei", 9, "wei")
CONTRACT_FACTS: Final = ("ens", "factory", "xrt", "isOurCode", "lighthouse", "lighthouseName", "wn")
"""The fields that are null in JSON if the chain has no contracts."""


@command.command("status", short_help="show the node, the contracts and the account's balances")
@with_json
@with_chain_settings("lighthouse_contract")
async def status(settings: Settings, as_json: bool) -> None:
    """Show the node and its chain, the settings for it, the contracts and which code they run, and the account's
    balances.

    The exit code is 1 if the chain has no contracts; everything else is still shown.
    """
    from mesh.role.composition import chain_of

    account = await asyncio.to_thread(own_address, settings)
    trouble: ChainError | None = None
    async with chain_of(settings, None, attempts=READ_ATTEMPTS).node as node:
        facts = dict.fromkeys(CONTRACT_FACTS) | await _node_facts(node, account) | await _profile_facts(node, settings)
        try:
            async with open_chain(settings) as chain:
                facts |= await _contract_facts(chain, settings.lighthouse_contract, account)
        except ChainError as error:
            trouble = error
    print_result(facts, _readable_status(facts), as_json=as_json)
    if trouble is not None:
        raise trouble


async def _node_facts(node: Node, account: str | None) -> dict[str, Any]:
    block = await node.heads.look()
    return {
        "node": node.endpoint,
        "client": printable(await node.client_version()),
        "chainId": node.chain_id,
        "blockNumber": block.number,
        "blockTime": block.timestamp,
        "baseFee": None if block.base_fee is None else str(block.base_fee),
        "account": account,
        "wei": None if account is None else str(await node.eth_balance(account)),
    }


async def _profile_facts(node: Node, settings: Settings) -> dict[str, Any]:
    """What is known of the chain, what the settings make of it, and how fast its blocks come."""
    from mesh.settings.chains import FILLED, profile_of

    profile, known = settings.profile, profile_of(node.chain_id)
    used = {name: getattr(settings, name) for name in FILLED}
    head = await node.block_number()
    seconds = await node.heads.block_time(MEASURED)
    return {
        "chain": profile.name or None,
        "title": profile.title if profile.name else known and known.title,
        "knownAs": known and known.name,
        "settings": used,
        "overridden": {name: getattr(profile, name) for name, value in used.items() if value != getattr(profile, name)},
        "finality": settings.finality,
        "final": max(0, await node.counted(head)),
        "blockSeconds": None if seconds is None else round(seconds, 2),
        "expectedBlockSeconds": profile.block_seconds if profile.chain_id else None,
        "coin": profile.coin,
        "tokens": dict(profile.tokens),
        "explorer": profile.explorer or None,
    }


async def _contract_facts(chain: Chain, lighthouse: str, account: str | None) -> dict[str, Any]:
    from mesh.chain import UnknownName

    try:
        address: str | None = await chain.names.lighthouse(lighthouse)
    except UnknownName:
        address = None
    return {
        "ens": chain.ens,
        "factory": chain.factory,
        "xrt": chain.xrt,
        "isOurCode": await chain.has_mesh_contracts(),
        "lighthouse": address,
        "lighthouseName": lighthouse,
        "wn": None if account is None else str(await chain.tokens.balance(account)),
    }


def _readable_status(facts: dict[str, Any]) -> dict[str, str | None]:
    """The status for people."""
    shown: dict[str, str | None] = {
        "node": f"{facts['node']}  {facts['client']}",
        "chain id": f"{facts['chainId']}{_named(facts)}",
        "block": f"{facts['blockNumber']:,}, {_ago(facts['blockTime'])}",
        "base fee": None if facts["baseFee"] is None else GWEI.show(int(facts["baseFee"])),
    }
    shown |= {
        "pace": _pace(facts),
        "settings": _used(facts),
        "finality": f"{facts['finality']}: what happened up to block {facts['final']:,} counts",
        "tokens": ", ".join(f"{symbol} {address}" for symbol, address in facts["tokens"].items()) or None,
        "explorer": facts["explorer"],
    }
    if facts["factory"] is not None:
        code = "this project's code" if facts["isOurCode"] else "not this project's code"
        found = facts["lighthouse"] or "not found:"
        shown |= {
            "contracts": code,
            "ENS registry": facts["ens"],
            "factory": facts["factory"],
            "XRT": facts["xrt"],
            "lighthouse": f"{found}  {facts['lighthouseName']}",
        }
    if facts["account"] is not None:
        amounts = [Unit(facts["coin"], 18, "wei").show(int(facts["wei"]))]
        if facts["wn"] is not None:
            amounts.append(XRT.show(int(facts["wn"])))
        shown["account"] = f"{facts['account']}  {', '.join(amounts)}"
    return shown


def _named(facts: dict[str, Any]) -> str:
    if facts["chain"] is not None:
        return f"  {facts['title']} ({facts['chain']})"
    return f'  {facts["title"]}; chain = "{facts["knownAs"]}" has its settings' if facts["knownAs"] else ""


def _pace(facts: dict[str, Any]) -> str | None:
    """How fast blocks come, and should come."""
    found, expected = facts["blockSeconds"], facts["expectedBlockSeconds"]
    if found is None:
        return None
    return f"a block every {found:g} s" + ("" if expected is None else f", {expected:g} s expected")


def _used(facts: dict[str, Any]) -> str:
    """The settings that a chain has, and what it has where they differ."""
    other = facts["overridden"]
    return ", ".join(
        f"{name} {value:,}" + (f" (the chain's: {other[name]:,})" if name in other else "")
        for name, value in facts["settings"].items()
    )


def _ago(timestamp: int) -> str:
    """How long ago a block was created, in a fitting unit."""
    seconds = max(0, int(time.time()) - timestamp)
    for name, length in (("day", 86_400), ("hour", 3_600), ("minute", 60)):
        if seconds >= 2 * length:
            return f"{seconds // length:,} {name}s ago"
    return f"{seconds} s ago"
