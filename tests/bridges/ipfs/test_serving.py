"""The RPC of an IPFS daemon, served from the mesh: with the IPFS client and the pages of 2018, and without IPFS."""

from __future__ import annotations

import asyncio
import json
import os
from base64 import b64encode
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import aiohttp
import pytest

from bridges.ipfs._serving import IpfsApi
from bridges.ipfs.daemon import Daemon, IpfsError
from bridges.ipfs.service import IpfsBridge
from mesh.base.background import Background
from mesh.content import Exchange, Store
from mesh.dev import JsonRpcServer
from mesh.network import Endpoints, Network
from mesh.testing._market import working_provider
from schemas import Demand, Empty, String, cid_of_bytes, cid_of_file, decode, encode
from tests.bridges.ros1.conftest import ros, rosmaster
from tests.support.ipfs_bridge.legacy import LegacyClient
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.peers import require
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from mesh.agent.handlers import Job
    from tests.support.ipfs import JsIpfs
    from tests.support.market import Place
    from tests.support.ros1.peers import Ros, RosMasterServer

__all__ = ["ros", "rosmaster"]

SCRIPTS: Final = Path(__file__).parent / "legacy_pages"


@asynccontextmanager
async def served(place: Place, *, size_limit: int = 1 << 20) -> AsyncIterator[IpfsApi]:
    """The RPC on a free port."""
    async with Network(Endpoints(connect=(place.endpoint,))) as network:
        store = Store(place.folder / "ipfs-api")
        async with (
            Exchange(network.session, store) as exchange,
            IpfsApi(network.session, store, exchange, port=0, size_limit=size_limit, timeout=3.0) as api,
        ):
            yield api
        store.close()


async def run(place: Place, client: str, *arguments: str) -> dict[str, Any]:
    """What a page with that client reports, by name."""
    folders, script = f"{require(client)}:{require('ipfs-api')}", f"order_{client[-1]}.cjs"
    process = await asyncio.create_subprocess_exec(
        "node", SCRIPTS / script, *arguments,
        env=os.environ | {"NODE_PATH": folders, "TMPDIR": str(place.folder)},
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    ending = asyncio.get_running_loop().call_later(60, process.kill)  # what it has reported is in the failure
    try:
        output, errors = await process.communicate()
    finally:
        ending.cancel()
        if process.returncode is None:
            process.kill()
    assert process.returncode == 0, (output.decode(), errors.decode())
    return {found["name"]: found["value"] for found in map(json.loads, output.splitlines())}


@pytest.mark.parametrize(("client", "generation"), [("robonomics-3", 3), ("robonomics-5", 5)])
async def test_a_legacy_page_orders_a_job_without_ipfs(place: Place, client: str, generation: Literal[3, 5]) -> None:
    """robonomics-js with its own IPFS provider and the IPFS client of its time: order, offer, result."""
    lighthouse = f"airalab.lighthouse.{generation}.robonomics.eth"
    robot = offering(place.agent("robot", generation=generation, lighthouse_contract=lighthouse))

    @robot.on("/blink")
    async def blink(job: Job, _message: Empty) -> None:
        job.publish("/led", "on")

    content = b64encode(objective(("/blink", None))).decode()
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        working_provider(network.session, place.chains["provider"], lighthouse),
        robot,
        served(place) as api,
        JsonRpcServer(place.node.provider) as node,
    ):
        found = await run(place, client, node.url, place.market.deployment.ens, api.url, MODEL, content)
    assert found["offer"] == place.address("robot")
    assert found["result"] == found["result message"]


@pytest.mark.parametrize("has_node", [False, True])
@pytest.mark.parametrize(("client", "generation"), [("robonomics-3", 3), ("robonomics-5", 5)])
async def test_a_legacy_page_orders_a_job_on_js_ipfs(
    place: Place, js_ipfs: JsIpfs, client: str, generation: Literal[3, 5], has_node: bool
) -> None:
    """robonomics-js with its own IPFS provider, on the daemon of the bridge or on a node in the page."""
    lighthouse = f"airalab.lighthouse.{generation}.robonomics.eth"
    options: Any = {"generation": generation, "lighthouse_contract": lighthouse}
    robot = offering(place.agent("robot", **options))

    @robot.on("/blink")
    async def blink(job: Job, _message: Empty) -> None:
        job.publish("/led", "on")

    content = b64encode(objective(("/blink", None))).decode()
    settings = place.settings("bridge", ipfs_http_provider=js_ipfs.api, **options)
    packages = require("js-ipfs").parents[2]
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        IpfsBridge(network, settings, chain=lambda: place.chain("provider")) as bridge,
        working_provider(network.session, place.chains["provider"], lighthouse),
        robot,
        JsonRpcServer(place.node.provider) as node,
        LegacyClient(js_ipfs.api) as daemon,
        Background() as tasks,
    ):
        tasks.start(bridge.run(), "bridge of the test")
        await until(lambda: bridge.channels[0].status().state in ("alone", "connected"))
        ens = place.market.deployment.ens
        ipfs = js_ipfs.swarm_address if has_node else js_ipfs.api
        found = await run(place, client, node.url, ens, ipfs, MODEL, content, str(packages))
        assert cid_of_bytes(await daemon.cat(found["result"])) == found["result"]
    assert found["offer"] == place.address("robot")
    assert found["result"] == found["result message"]


async def test_a_legacy_page_orders_with_a_bag_and_gets_a_bag(
    place: Place, rosmaster: RosMasterServer, ros: Callable[[str], Ros]
) -> None:
    """From real `rosbag record` to real `rosbag play`, and nothing of the person's is newer than 2018."""
    tools = ros(rosmaster.uri)
    robot = offering(place.agent("robot", bag_results=True))

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        job.publish("/led", message.data)

    task, result = place.folder / "objective.bag", place.folder / "result.bag"
    async with tools.node("talker", "/blink") as talker:
        assert await talker.hear() == "ready"
        async with tools.recording("-O", str(task), "-l", "1", "/blink"):
            talker.tell("red")
    before = await place.balance("robot")
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        working_provider(network.session, place.chains["provider"], "airalab.lighthouse.3.robonomics.eth"),
        robot,
        served(place) as api,
        JsonRpcServer(place.node.provider) as node,
    ):
        content = b64encode(task.read_bytes()).decode()
        found = await run(place, "robonomics-3", node.url, place.market.deployment.ens, api.url, MODEL, content)
        async with LegacyClient(api.url) as client:
            result.write_bytes(await client.cat(found["result"]))
    assert found["result"] == found["result message"] == cid_of_file(result)
    assert await place.balance("robot") == before + 42
    below = f"/liability/eth_{found['liability']}"
    async with tools.node("listener", f"{below}/led") as listener:
        assert await listener.hear() == "ready"
        info = await tools.run("rosbag", "info", "-y", str(result))
        await tools.run(
            "rosbag", "play", "-q", "--wait-for-subscribers", "--topics", f"{below}/led", "--bags", str(result)
        )
        assert await listener.hear() == "red"
    assert "messages: 2\n" in info
    assert "indexed: True" in info
    assert all(f"topic: {below}{topic}\n" in info for topic in ("/blink", "/led"))


async def test_our_own_client_of_daemons_understands_it(place: Place) -> None:
    """In the dialect of its version: published messages come back, files by their CIDs."""
    async with place.agent("person") as person, served(place) as api, Daemon(api.url) as daemon:
        await daemon.detect_version()
        topic = place.market.deployment.lighthouse_name
        demand = person.parts.signer.sign(
            Demand(
                model=MODEL, objective=cid_of_bytes(b"x"), token=place.address("robot"), cost=2**60,
                lighthouse=place.market.deployment.lighthouse, validator="0x" + "0" * 40, validator_fee=0,
                deadline=2**40, nonce="5a" * 32,
            )
        )  # fmt: skip
        heard = list[bytes]()
        async with daemon.subscribe(topic) as messages:

            async def hear() -> None:
                async for message in messages:
                    if message is not None:
                        heard.append(message.data)

            hearing = asyncio.create_task(hear())
            while not heard:
                await daemon.publish(topic, encode(demand))
                await asyncio.sleep(0.1)
            hearing.cancel()
        assert decode(heard[0]) == demand
        (place.folder / "file").write_bytes(b"content")
        assert await daemon.add(place.folder / "file") == cid_of_bytes(b"content")
        with pytest.raises(IpfsError):
            await daemon.publish(topic, encode(demand)[:-9] + b'0000"}')


async def test_pages_from_elsewhere_are_refused(place: Place) -> None:
    """A page of a stranger would publish in its visitor's name."""
    async with served(place, size_limit=10) as api, aiohttp.ClientSession() as http:
        for origin, status in (("https://evil.example", 403), ("http://localhost:8080", 200), ("", 200)):
            headers = {"Origin": origin} if origin else {}
            async with http.post(f"{api.url}/api/v0/version", headers=headers) as answer:
                assert answer.status == status
                allowed = answer.headers.get("Access-Control-Allow-Origin")
                assert allowed == (origin if origin and status == 200 else None)
        form = aiohttp.FormData()
        form.add_field("file", b"x" * 11, filename="f")
        async with http.post(f"{api.url}/api/v0/add", data=form) as answer:
            assert answer.status == 500
            assert "more than 10 bytes" in await answer.text()
