"""`aira chain`: the network's contracts on a chain, what a job costs there, and a chain for development.

The cost goes by measured gas, and by bytes of data. `tests/contracts/test_gas.py` measures the gas again, on the same
EVM as `bench/gas.py`.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from mesh.amounts import XRT, Unit
from mesh.cli import LazyGroup
from mesh.cli.chain_client import READ_ATTEMPTS, open_chain, own_address
from mesh.cli.lighthouse import check_lighthouse
from mesh.cli.options import FiniteRange, with_chain_settings, with_json, with_lighthouse_options, with_signing_settings
from mesh.cli.output import print_json, print_line, print_result, print_table, printable
from mesh.errors import ChainError, ConfigurationError

if TYPE_CHECKING:
    from mesh.chain import Account, Chain, Deployment, Node
    from mesh.settings import Settings


DEPLOYMENT_GAS: Final = 13_000_000
"""Slightly more than a whole deployment uses where it costs most: 9.9 million today, a fifth more on geth's next fork.
An account that can't pay for it is rejected at the start."""


command = LazyGroup(
    "chain",
    help="Run a development chain; deploy and inspect the network's contracts on any chain.",
    lazy={"up": ("mesh.cli.up:chain_up", "serve a development chain with the contracts")},
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
        refund_delay=refund_delay or settings.profile.blocks_in(7 * 86_400),
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
    seconds = await node.heads.block_time()
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


class JobTransaction(NamedTuple):
    """A transaction of a job that pays in XRT.

    Its name among the measurements, who sends it and when; its gas in generations 3 and 5; the bytes of its data that
    are not zero, about.
    """

    name: str
    title: str
    sender: str
    gas: tuple[int, int]
    data: int

    def gas_in(self, generation: int) -> int:
        """Its gas in a generation."""
        return self.gas[generation == 5]


STEPS: Final = (
    JobTransaction("create_cost", "create the contract", "the provider", (206_600, 163_300), 450),
    JobTransaction("finalize_cost", "finalize it", "the provider", (112_400, 111_300), 130),
    JobTransaction("approve", "approve the factory", "the customer, once for many jobs", (45_900, 45_900), 45),
    JobTransaction("create_permit", "create it with a permit", "the provider, instead", (218_000, 174_600), 590),
    JobTransaction("refund", "refund it", "the customer, if nobody finalizes", (78_100, 78_500), 25),
    JobTransaction("withdraw_order", "withdraw an order on the chain", "its maker, if asked for", (46_200, 28_300), 37),
)
"""Each job has the first two."""

EACH_JOB: Final = 2
"""So many steps."""


@dataclass(frozen=True, slots=True)
class Priced:
    """A transaction with what it costs, in wei; `data` is the part of it for its data."""

    name: str
    title: str
    sender: str
    gas: int
    wei: int
    data: int

    def json(self, coin_price: float | None) -> dict[str, Any]:
        """The same for JSON."""
        facts = {"step": self.name, "gas": self.gas, "wei": str(self.wei), "dataWei": str(self.data)}
        return facts if coin_price is None else facts | {"usd": round(self.usd(coin_price), 6)}

    def usd(self, coin_price: float) -> float:
        """The same in money, by the price of a coin."""
        return self.wei / 10**18 * coin_price


@command.command("cost", short_help="show what a job costs, in the chain's coin and in money")
@click.option("--gas-price", help="gwei for a unit of gas, instead of asking the node; data is not counted then")
@click.option("--coin-price", type=FiniteRange(0, 1e12, min_open=True), help="USD for one of the chain's coin")
@with_json
@with_chain_settings("generation")
async def cost(settings: Settings, *, gas_price: str | None, coin_price: float | None, as_json: bool) -> None:
    """Show what the transactions of a job cost now on the chain of the settings, and who pays them.

    The gas is measured: that of a job that is paid in XRT, without a fee. Its price is the node's, and so is the fee
    for data on rollups of the OP type. With --gas-price no node is asked; --coin-price adds the price in money.
    """
    from mesh.role.composition import chain_of
    from mesh.settings.chains import profile_of

    profile, fees = settings.profile, [0] * len(STEPS)
    if gas_price is not None:
        price = GWEI.parse(gas_price)
    else:
        async with chain_of(settings, None).node as node:
            price = (await node.gas_market()).price
            fees = [await node.data_fee(b"\1" * step.data) for step in STEPS]
            profile = profile_of(node.chain_id) or profile
    steps = []
    for step, fee in zip(STEPS, fees, strict=True):
        gas = step.gas_in(settings.generation)
        steps.append(Priced(step.name, step.title, step.sender, gas, gas * price + fee, fee))
    gas, wei, data = (sum(getattr(one, name) for one in steps[:EACH_JOB]) for name in ("gas", "wei", "data"))
    job = Priced("job", "together: a job", "", gas, wei, data)
    if as_json:
        facts: dict[str, Any] = {"chain": profile.name, "coin": profile.coin, "gasPrice": str(price)}
        facts |= {"coinPrice": coin_price, "job": job.json(coin_price)}
        print_json(facts | {"steps": [one.json(coin_price) for one in steps]})
        return
    print_line(f"{profile.title}, gas at {GWEI.show(price)}")
    coin = Unit(profile.coin, 18, "wei")
    head = ("STEP", "WHO PAYS", "GAS", profile.coin, *(() if coin_price is None else ("USD",)))
    rows = []
    for one in (*steps[:EACH_JOB], job, *steps[EACH_JOB:]):
        money = () if coin_price is None else (f"{one.usd(coin_price):.4f}",)
        rows.append((one.title, one.sender, f"{one.gas:,}", coin.number(one.wei), *money))
    print_table(head, rows, numbers=head[2:])
    if profile.l1 == "op":
        is_counted = "counted" if gas_price is None else "not counted: leave out --gas-price to ask the node"
        print_line(f"the fee for data, beside the gas, is {is_counted}")
