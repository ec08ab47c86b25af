"""What a bridge knows of the chain, whose node comes and goes."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

from bridges.ipfs.market import Markets
from mesh.background import Background
from mesh.chain import Chain, Timing
from mesh.devchain import JsonRpcServer
from mesh.errors import ChainError
from tests.support.market import founded, place
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.support.market import Place

__all__ = ["founded", "place"]

SECONDS = 60.0
UNKNOWN = "nobody.lighthouse.3.robonomics.eth"


async def test_the_chain_is_known_from_when_its_node_is_there_and_stays_known_when_it_goes(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "bridges.ipfs.market")
    deployment, port = place.market.deployment, free_port()
    name = deployment.lighthouse_name

    attempts: list[int] = []

    def chain() -> Chain:
        attempts.append(port)
        return Chain(f"http://127.0.0.1:{port}", ens=deployment.ens, timing=Timing(poll_interval=0.05))

    markets = Markets(chain, (name, UNKNOWN), interval=0.05, again=0.1)
    async with Background() as tasks:
        tasks.start(markets.run(), "the chain")
        await until(lambda: len(attempts) == 3, seconds=SECONDS)
        assert (markets.address(name), markets.head) == (None, 0)
        with pytest.raises(ChainError, match="not there yet"):
            await markets.resolve(name)

        async with JsonRpcServer(place.node.provider, host="127.0.0.1", port=port):
            await until(lambda: markets.address(name), seconds=SECONDS)
            assert markets.address(name) == deployment.lighthouse
            assert markets.head > 0
            assert await markets.resolve(name) == deployment.lighthouse
            # A lighthouse that the chain does not know does not keep the others from working.
            await until(lambda: UNKNOWN in markets.error, seconds=SECONDS)
            assert markets.address(UNKNOWN) is None

        await until(lambda: UNKNOWN not in markets.error, what="the loss of the node", seconds=SECONDS)
        assert markets.address(name) == deployment.lighthouse
    said = [record.getMessage() for record in caplog.records if record.name == "bridges.ipfs.market"]
    assert len([line for line in said if "until the chain's node is there" in line]) == 1
