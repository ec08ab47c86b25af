"""Both legacy JavaScript clients, as their pages used them, with the accounts that the node signs for."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.dev.development import DevelopmentChain, serve_chain
from mesh.settings import Settings
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SCRIPTS: Final = Path(__file__).parent / "legacy"
SECONDS: Final = 120.0
MODEL: Final = "QmfCcLKrTCuXsf6bHbVupVv4zsbs6kjqTQ7DRftGqMLjdW"
OBJECTIVE: Final = "Qmbm3o2wkqseSEi5F69CPAuDrsKnrwTJ3HN5FVLPgLHKUm"
RESULT: Final = "QmWboFP8XeBtFMbNYK3Ne8Z3gKFBSR5iQzkKgeNgQz3dZ4"
TOKEN: Final = {"name": "Robonomics", "totalSupply": 10**15, "decimals": 9, "symbol": "XRT"}
STAKE: Final = 100 * 10**9
FIRST_ACCOUNT: Final = "0xf39fd6e51aad88f6f4ce6ab8827279cfffb92266"
NO_ACCOUNT: Final = "0x" + "00" * 20
JOB: Final = {
    "model": MODEL,
    "objective": OBJECTIVE,
    "result": RESULT,
    "cost": 1_000,
    "parties": [True, True],
    "lighthouse": True,
    "isSuccess": True,
    "isFinalized": True,
}


@pytest.fixture(params=["embedded", "anvil"])
async def chain(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[DevelopmentChain]:
    """Anvil mines empty blocks as well: web3 1.x may miss the block of its transaction, and looks again at the next."""
    is_anvil = request.param == "anvil"
    async with serve_chain(
        Settings(data_dir=str(tmp_path)),
        host="127.0.0.1",
        port=0,
        block_time=0.5 if is_anvil else None,
        anvil=require("anvil") if is_anvil else None,
    ) as served:
        yield served


async def run(client: str, url: str, chain: DevelopmentChain) -> dict[str, Any]:
    """What each function of the client gave, by name."""
    process = await asyncio.create_subprocess_exec(
        "node",
        SCRIPTS / f"{client.replace('-', '_')}.cjs",
        url,
        chain.market.deployment.ens,
        env=os.environ | {"NODE_PATH": str(require(client))},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(SECONDS):
            output, errors = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
    assert process.returncode == 0, (output.decode(), errors.decode())
    return {found["name"]: found["value"] for found in map(json.loads, output.splitlines())}


async def test_each_function_of_robonomics_js_0_3_0_works(chain: DevelopmentChain) -> None:
    """By HTTP: it polls blocks and receipts, and lists lighthouses with a filter."""
    found = await run("robonomics-3", chain.url, chain)
    assert found.pop("coinbase") is (chain.engine == "embedded"), "anvil's coinbase is address 0"
    assert found == {
        "lighthouses": [f"{name}.lighthouse.3.robonomics.eth" for name in ("airalab", "legacy3")],
        "watched lighthouse": ["legacy3"],
        "token": TOKEN,
        "another token": TOKEN,
        "allowance": STAKE,
        "members": [True],
        "staked": STAKE,
        "staked after withdrawal": STAKE // 2,
        "lighthouse": {"minimalFreeze": 1_000, "timeoutBlocks": 25},
        "ens": [True, True],
        "model": MODEL,
        "markets": [],
        "one liability": [True, True],
        "worker": True,
        "result": RESULT,
        "info": JOB,
        "paid": 1_000,
    }


async def test_each_function_of_robonomics_js_0_6_3_works(chain: DevelopmentChain) -> None:
    """By WebSocket: it subscribes to events."""
    found = await run("robonomics-5", chain.ws_url, chain)
    assert found.pop("coinbase") == (FIRST_ACCOUNT if chain.engine == "embedded" else NO_ACCOUNT)
    assert found == {
        "accounts": 10,
        "watched lighthouse": "legacy5",
        "lighthouse": "legacy5.lighthouse.5.robonomics.eth",
        "token": TOKEN,
        "another token": TOKEN,
        "receipt": True,
        "allowance": STAKE,
        "providers": [True],
        "staked": STAKE,
        "staked after withdrawal": STAKE // 2,
        "lighthouse info": {"minimalStake": 1_000, "timeoutInBlocks": 25},
        "one liability": True,
        "nonce": 1,
        "worker": True,
        "result": RESULT,
        "read result": RESULT,
        "info": JOB,
        "paid": 1_000,
        "messages": [["demand", True], ["offer", True], ["result", True]],
        "statements": ['["feedback",true]', '["pending","0x03"]'],
        "created by type": True,
    }
