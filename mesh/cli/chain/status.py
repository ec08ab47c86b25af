"""`aira chain status`: what there is on a chain."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.amounts import ETH, XRT, Unit
from mesh.cli.opening import for_reading, own_address, reading
from mesh.cli.printing import print_facts, print_json, visible, with_json
from mesh.errors import ChainError
from mesh.running import run_to_end

if TYPE_CHECKING:
    from mesh.chain import Chain, Node
    from mesh.settings import Settings

GWEI: Final = Unit("gwei", 9, "wei")
CONTRACT_FACTS: Final = ("ens", "factory", "xrt", "isOurCode", "lighthouse", "lighthouseName", "wn")
"""What is null, for programs, as long as there are no contracts."""


@click.command("status")
@with_json
@for_reading("lighthouse_contract")
def command(settings: Settings, as_json: bool) -> None:
    """Show what there is: the node and its chain, the contracts and whose they are, the account's money.

    What could be learned is shown in any case; the exit code is 1 when the chain has no contracts.
    """
    run_to_end(lambda: _status(settings, as_json))


async def _status(settings: Settings, as_json: bool) -> None:
    from mesh.composition import chain_of

    account = await asyncio.to_thread(own_address, settings)
    trouble: ChainError | None = None
    async with chain_of(settings, None).node as node:
        facts = dict.fromkeys(CONTRACT_FACTS) | await _node_facts(node, account)
        try:
            async with reading(settings) as chain:
                facts |= await _contract_facts(chain, settings.lighthouse_contract, account)
        except ChainError as error:
            trouble = error
    if as_json:
        print_json(facts)
    else:
        print_facts(_spoken(facts))
    if trouble is not None:
        raise trouble


async def _node_facts(node: Node, account: str | None) -> dict[str, Any]:
    block = await node.web3.eth.get_block("latest")
    base_fee = block.get("baseFeePerGas")
    return {
        "node": node.endpoint,
        "client": visible(str(await node.web3.client_version)),
        "chainId": node.chain_id,
        "blockNumber": int(block["number"]),
        "blockTime": int(block["timestamp"]),
        "baseFee": None if base_fee is None else str(int(base_fee)),
        "account": account,
        "wei": None if account is None else str(await node.eth_balance(account)),
    }


async def _contract_facts(chain: Chain, lighthouse: str, account: str | None) -> dict[str, Any]:
    from mesh.chain import UnknownName
    from mesh.chain.recognition import is_ours

    try:
        address: str | None = await chain.names.lighthouse(lighthouse)
    except UnknownName:
        address = None
    return {
        "ens": chain.ens,
        "factory": chain.factory,
        "xrt": chain.xrt,
        "isOurCode": await is_ours(chain),
        "lighthouse": address,
        "lighthouseName": lighthouse,
        "wn": None if account is None else str(await chain.tokens.balance(account)),
    }


def _spoken(facts: dict[str, Any]) -> dict[str, str | None]:
    """The same as people read it."""
    spoken: dict[str, str | None] = {
        "node": f"{facts['node']}  {facts['client']}",
        "chain id": str(facts["chainId"]),
        "block": f"{facts['blockNumber']:,}, {_ago(facts['blockTime'])}",
        "base fee": None if facts["baseFee"] is None else GWEI.show(int(facts["baseFee"])),
    }
    if facts["factory"] is not None:
        whose = "this project's, by their code" if facts["isOurCode"] else "not this project's code"
        there = facts["lighthouse"] or "none of that name"
        spoken |= {
            "contracts": whose,
            "ENS registry": facts["ens"],
            "factory": facts["factory"],
            "XRT": facts["xrt"],
            "lighthouse": f"{there}  {facts['lighthouseName']}",
        }
    if facts["account"] is not None:
        amounts = [ETH.show(int(facts["wei"]))]
        if facts["wn"] is not None:
            amounts.append(XRT.show(int(facts["wn"])))
        spoken["account"] = f"{facts['account']}  {', '.join(amounts)}"
    return spoken


def _ago(timestamp: int) -> str:
    """How long ago a block was made, in the unit that says it best."""
    seconds = max(0, int(time.time()) - timestamp)
    for name, length in (("day", 86_400), ("hour", 3_600), ("minute", 60)):
        if seconds >= 2 * length:
            return f"{seconds // length:,} {name}s ago"
    return f"{seconds} s ago"
