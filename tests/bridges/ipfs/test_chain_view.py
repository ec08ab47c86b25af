"""The bridge's view of the chain during outages of its node."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

from bridges.ipfs.service import ChainView
from mesh.base.background import Background
from mesh.base.retry import RetryPolicy
from mesh.chain import Chain, Timing
from mesh.dev import JsonRpcServer
from mesh.errors import ChainError
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.support.market import Place


SECONDS = 60.0
UNKNOWN = "nobody.lighthouse.3.robonomics.eth"


async def test_chain_data_is_read_once_the_node_is_reachable_and_kept_during_an_outage(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "bridges.ipfs.service")
    deployment, port = place.market.deployment, free_port()
    name = deployment.lighthouse_name

    attempts: list[int] = []

    def chain() -> Chain:
        attempts.append(port)
        return Chain(f"http://127.0.0.1:{port}", contracts=deployment.contracts, timing=Timing(poll_interval=0.05))

    retry = RetryPolicy(initial=0.1, ceiling=0.1)
    view = ChainView(chain, (name, UNKNOWN), interval=0.05, retry=retry)
    async with Background() as tasks:
        tasks.start(view.run(), "the chain")
        await until(lambda: len(attempts) == 3, seconds=SECONDS)
        assert (view.rules[name].address, view.head) == (None, 0)
        with pytest.raises(ChainError, check=lambda error: error.code == "chain-awaited"):
            await view.resolve(name)
        with pytest.raises(ChainError, check=lambda error: error.code == "chain-awaited"):
            await view.is_safe(deployment.xrt)

        async with JsonRpcServer(place.node.provider, host="127.0.0.1", port=port):
            await until(lambda: view.rules[name].address, seconds=SECONDS)
            assert view.rules[name].address == deployment.lighthouse
            assert view.head > 0
            assert await view.resolve(name) == deployment.lighthouse
            assert await view.is_safe(place.market.accounts["provider"].address)
            for contract in (deployment.lighthouse, deployment.xrt):
                assert not await view.is_safe(contract)
            # An unknown lighthouse does not affect the others.
            await until(lambda: UNKNOWN in view.error, seconds=SECONDS)
            assert view.rules[UNKNOWN].address is None

        await until(lambda: UNKNOWN not in view.error, what="the loss of the node", seconds=SECONDS)
        assert view.rules[name].address == deployment.lighthouse
    outages = [record for record in caplog.records if record.__dict__.get("event") == "chain-outage"]
    assert len([record for record in outages if "until the chain's node is reachable" in record.getMessage()]) == 1
