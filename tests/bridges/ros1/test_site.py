"""The bridge on a site with certificates."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from mesh.network import Network
from mesh.ops.identity import Member
from mesh.testing._market import working_provider
from schemas import Empty
from tests.support.market import Place
from tests.support.ros1.jobs import bridged
from tests.support.sites import Site

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from bridges.ros1.node import Ros1Graph
    from mesh.testing import MarketChain
    from tests.support.ros1.peers import Ros


async def test_a_job_of_a_node_is_paid_on_a_site_where_the_bridge_has_the_identity_of_its_agent(
    market_chain: MarketChain,
    graph: Callable[[], AbstractAsyncContextManager[Ros1Graph]],
    ros: Callable[[str], Ros],
    messages: dict[str, Path],
    tmp_path: Path,
) -> None:
    """It calls the agent's services, which no other member may."""
    site = Site(tmp_path / "site")
    async with Place(market_chain, site.endpoint, tmp_path) as place:
        roles = {"robot": "agent", "person": "person", "provider": "provider"}
        folders = {
            name: site.enlist(Member(name=name, address=place.address(name), roles=(role,)))  # type: ignore[arg-type]
            for name, role in roles.items()
        }
        robot, person = (
            place.agent(
                name,
                open_services=True,
                tls_ca=str(folders[name].ca),
                tls_certificate=str(folders[name].certificate),
                tls_key=str(folders[name].key),
            )
            for name in ("robot", "person")
        )
        before = await place.balance("robot")
        lighthouse = place.market.deployment.lighthouse_name
        with site.open_router(site.kind):
            async with (
                asyncio.timeout(90),
                Network(site.client(folders["provider"])) as network,
                working_provider(network.session, place.chains["provider"], lighthouse),
                robot,
                person,
                graph() as here,
                bridged(place, robot, here, endpoints=site.client(folders["robot"])),
                ros(here.master).node("blink", messages=messages["5"]) as node,
            ):
                assert await node.hear() == "ready"
                contract = await person.demand([("/blink", Empty())], cost=42)
                assert (await contract.outcome()).success
        assert await place.balance("robot") == before + 42
