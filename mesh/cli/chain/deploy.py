"""`aira chain deploy`: the contracts, put on a chain."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.amounts import XRT
from mesh.cli.lighthouse.checks import check_lighthouse
from mesh.cli.lighthouse.rules import with_rules
from mesh.cli.opening import for_signing
from mesh.cli.printing import print_facts, print_json, say, with_json
from mesh.errors import ConfigurationError
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.chain import Account, Deployment, Node
    from mesh.settings import Settings

DEPLOYMENT_GAS: Final = 9_500_000
"""A little more than what a deployment takes in all; an account that can't pay for it is told so before it begins."""


@click.command("deploy")
@click.option("--lighthouse", default="airalab", show_default=True, help="name of the first lighthouse, one label")
@with_rules
@click.option(
    "--refund-delay",
    type=click.IntRange(1, 2**32 - 1),
    default=50_400,
    show_default=True,
    help="blocks until an unfinished job's money can be had back; it can't be changed later",
)
@click.option("--again", is_flag=True, help="deploy though the chain has contracts; the old ones stay as they are")
@with_json
@for_signing()
def command(settings: Settings, **options: Any) -> None:
    """Put the contracts on the chain: ENS registry and names, XRT, factory, and a first lighthouse.

    The settings' account pays the gas, owns the names and gets the first million XRT. About twenty transactions are
    sent, one after another. What to put into the settings of those who use them is printed.
    """
    run_to_end(lambda: _deploy(settings, **options))


async def _deploy(
    settings: Settings,
    *,
    lighthouse: str,
    minimal_stake: str,
    timeout_blocks: int,
    refund_delay: int,
    again: bool,
    as_json: bool,
) -> None:
    from mesh.chain import DeploymentPlan, deploy
    from mesh.composition import chain_of, load_account

    plan = DeploymentPlan(
        lighthouse=lighthouse,
        minimal_stake=XRT.parse(minimal_stake),
        timeout_blocks=timeout_blocks,
        refund_delay=refund_delay,
    )
    check_lighthouse(plan.lighthouse, minimal_stake=plan.minimal_stake)  # which comes last, and would be refused then
    account = await asyncio.to_thread(load_account, settings)
    node = chain_of(settings, account).node
    async with node:
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
    from mesh.composition import chain_of

    try:
        async with chain_of(settings, None) as chain:
            raise ConfigurationError(
                f"the chain {node.chain_id} has the contracts already (factory {chain.factory})",
                hint="use those, or deploy a second set with --again; the lighthouse of another name: "
                "`aira lighthouse create`",
            )
    except NoContracts:
        return


async def _check_affordable(node: Node, account: Account) -> None:
    from mesh.chain import InsufficientFunds

    balance = await node.eth_balance(account.address)
    needed = DEPLOYMENT_GAS * int(await node.web3.eth.gas_price)
    if balance < needed:
        raise InsufficientFunds(account.address, balance=balance, needed=needed)


def _print_deployment(settings: Settings, deployment: Deployment, *, chain_id: int, as_json: bool) -> None:
    options = {
        "web3_http_provider": settings.web3_http_provider,
        "ens_contract": deployment.ens,
        "lighthouse_contract": deployment.lighthouse_name,
    }
    if as_json:
        print_json(
            {
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
        )
        return
    print_facts(
        {
            "ENS registry": deployment.ens,
            "resolver": deployment.resolver,
            "XRT": deployment.xrt,
            "factory": deployment.factory,
            "lighthouse": f"{deployment.lighthouse}  {deployment.lighthouse_name}",
            "block": f"{deployment.block_number:,}",
            "gas used": f"{deployment.gas_used:,}",
        }
    )
    say("\nsettings of those who use it:\n")
    for name, value in options.items():
        say(f'{name} = "{value}"')
