"""Whole paid jobs, done by nodes of rospy that know nothing but the legacy stack."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, suppress
from re import findall
from typing import TYPE_CHECKING

import pytest

from bridges.ros1._definitions import service_types
from bridges.ros1._legacy import decimal
from bridges.ros1._wire import Ros1Error
from bridges.ros1.messages import plain
from bridges.ros1.node import Ros1Graph, Ros1Node
from mesh.agent.ledger import Phase
from mesh.network import Endpoints, Network
from mesh.recording import open_objective
from schemas import Empty, OrderFeedback, Result, String, TransactionFeedback, encode
from schemas.keys import market_selector
from tests.support.bags import Bag, BagMessage
from tests.support.boards import board, edge
from tests.support.market import MODEL, in_phase, offering
from tests.support.ros1.jobs import bridged
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from mesh.agent.contracts import Contract
    from tests.support.market import Place
    from tests.support.ros1.jobs import Scene
    from tests.support.ros1.peers import Ros, RosMasterServer

    Opened = Callable[..., AbstractAsyncContextManager[Scene]]


async def recorded(contract: Contract) -> list[tuple[str, str, str]]:
    """Topic, type and text of each message in the recording of a job."""
    found = open_objective(await contract.recording()).messages()
    return [(one.topic, one.type.schema_name, getattr(one.value, "data", one.value) or "") for one in found]


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", ["3", "4", "5"])
@pytest.mark.parametrize(("argument", "message", "word"), [("Empty", Empty(), "on"), ("String", String("red"), "red")])
async def test_a_tutorial_node_does_a_paid_job(
    scene: Opened, generation: str, argument: str, message: object, word: str
) -> None:
    """It offers, starts the job, blinks, says so and finishes: what it says is in the recording, and it is paid."""
    async with scene() as here, here.node("blink", argument, generation=generation) as node:
        before = await here.place.balance("robot")
        contract = await here.person.demand([("/blink", message)], cost=42)
        assert await node.hear() == {"started": True}
        assert await node.hear() == {"blink": word}
        assert (await contract.outcome()).success
        assert await recorded(contract) == [
            ("/blink", f"std_msgs/{argument}", "" if argument == "Empty" else word),
            ("/led", "std_msgs/String", word),
        ]
        assert await here.place.balance("robot") == before + 42


async def test_the_node_of_the_first_tutorial_greets_and_is_paid(scene: Opened) -> None:
    """It hears whose demand is for its model, and ends the job in the callback that says its answer."""
    async with scene() as here, here.node("hello", MODEL, generation="5") as node:
        before = await here.place.balance("robot")
        contract = await here.person.demand([("/task", "person")], cost=42)
        assert await node.hear() == "Hello AIRA"
        assert (await contract.outcome()).success
        assert await recorded(contract) == [
            ("/task", "std_msgs/String", "person"),
            ("/data", "std_msgs/String", "Hello person"),
        ]
        assert await here.place.balance("robot") == before + 42


async def test_a_tutorial_node_answers_a_bag_with_a_bag(scene: Opened) -> None:
    """With `bag_results`: what was played and what it says, with the names of the ROS graph."""
    async with scene(bag_results=True) as here, here.node("blink", "String", generation="5"):
        task = Bag([BagMessage("/blink", String("red").encode(), 1)]).encode()
        contract = await here.person.demand(here.place.save(task, "objective.bag"))
        assert (await contract.outcome()).success
        info = await here.tools.run("rosbag", "info", "-y", str(await contract.recording()))
    below = f"/liability/eth_{contract.address}"
    assert findall("topic: (.*)", info) == [f"{below}/blink", f"{below}/led"]
    assert info.count("type: std_msgs/String") == 3  # once in the list of types


async def test_a_sensor_answers_a_free_demand_with_a_bag_of_what_its_board_says(scene: Opened) -> None:
    """The board is on an edge agent, outside any job: the node hears it as on rosserial, makes a real bag, puts it into
    our store and signs a result; whoever demanded it reads the bag."""
    async with scene() as here, here.person.channel.subscribe(Result) as results:
        with ExitStack() as stack:
            uno = stack.enter_context(board("examples/air_pollution/air_rosserial"))
            serial = edge(uno.port, here.robot.address, here.place.endpoint, "--protocol", "rosserial")
            await asyncio.to_thread(stack.enter_context, serial)
            async with here.node("sensor", generation="5") as node:
                await here.person.order([("/measure", None)])
                said = await node.hear()
                assert said["added"], said["why"]
                result = (await anext(results)).message  # a node that ends may leave it unsent
        assert result.result == said["cid"]
        bag = open_objective(await here.person.fetch(result.result))
        [(topic, reading)] = [(one.topic, one.value) for one in bag.messages()]
        assert topic == "/measurements"
        assert len(str(reading).split()) == 6


async def test_a_job_whose_node_dies_fails_with_the_reason(scene: Opened) -> None:
    """The person is refunded, and reads why."""
    async with scene(gone_seconds=1.0) as here, here.node("blink", "Empty", "die"):
        before = await here.place.balance("person")
        contract = await here.person.demand([("/blink", Empty())], cost=42)
        outcome = await contract.outcome()
        assert (outcome.success, outcome.code) == (False, "ros1-node-gone")
        assert await here.place.balance("person") == before


async def test_a_bridge_that_is_started_again_in_a_job_goes_on_with_it(
    place: Place, graph: Callable[[], AbstractAsyncContextManager[Ros1Graph]], ros: Callable[[str], Ros],
    messages: dict[str, Path],
) -> None:  # fmt: skip
    """A job that was ready meanwhile is shown to nodes, and recorded, and the node ends it."""
    robot = place.agent("robot", open_services=True)
    async with asyncio.timeout(60), graph() as here, place.at_work(offering(robot)) as person:
        async with bridged(place, robot, here):
            """Gone when the contract comes."""
        contract = await person.demand([("/blink", Empty())])
        await in_phase(robot, contract, Phase.READY)
        async with bridged(place, robot, here), ros(here.master).node("blink", messages=messages["5"]) as node:
            assert await node.hear() in ("ready", {"started": True})
            assert (await contract.outcome()).success
        assert ("/led", "std_msgs/String", "on") in await recorded(contract)


async def test_services_show_the_account_in_the_units_of_the_original(scene: Opened) -> None:
    """Balances in XRT and ether, allowances in the smallest unit; what spends is refused unless it is allowed."""
    async with scene(open_services=False) as here:
        tools = here.tools
        tools.environment["PYTHONPATH"] = str(here.messages["3"] / "python")
        services = ("/eth/accounts", "/eth/xrt_balance", "/eth/xrt_allowance", "/eth/current_block")
        accounts, balance, allowance, _block, transfer = await asyncio.gather(
            *(tools.run("rosservice", "call", name) for name in services),
            tools.run("rosservice", "call", "/eth/transfer", "{to: {address: '0x1'}, value: {uint256: '1'}}"),
        )
        assert here.robot.address in accounts
        assert f'uint256: "{decimal(await here.place.balance("robot"), 9)}"' in balance
        assert 'uint256: "' in allowance
        assert "open_services" in transfer


async def test_a_node_asks_whether_a_job_has_ended_and_how_far_it_is(scene: Opened) -> None:
    """As the nodes of 2019 did: the time is that of the message that was played last, in the objective."""
    exists, timestamp = (
        next(iter(service_types()[f"robonomics_liability/Persistence{name}"].values()))
        for name in ("ContainsLiability", "LiabilityTimestamp")
    )
    async with (
        scene() as here,
        Ros1Node(Ros1Graph(here.graph.master), "/test") as asking,
        here.node("blink", "String", "told") as node,
    ):
        played = Bag([BagMessage("/blink", String("red").encode(), 7_000_000_005)])
        contract = await here.person.demand(here.place.save(played.encode(), "blink.bag"))
        assert await node.hear() == {"started": True}
        assert await node.hear() == {"blink": "red"}
        request = {"address": contract.address}

        async def is_played() -> bool:
            reply = await asking.call("/liability/persistence/get_liability_timestamp", timestamp, request)
            return reply == {"timestamp": (7, 5)}

        await until_found(is_played, what="the time of the message")
        assert await asking.call("/liability/persistence/exists", exists, request) == {"exists": True}
        node.tell("go on")
        assert (await contract.outcome()).success
        assert await asking.call("/liability/persistence/exists", exists, request) == {"exists": False}


async def test_what_providers_of_generation_5_say_about_orders_is_heard(scene: Opened) -> None:
    """Real `rostopic echo` prints it."""
    async with scene() as here, Network(Endpoints(connect=(here.place.endpoint,))) as network:
        below = "/liability/infochan/incoming/feedback"
        here.tools.environment["PYTHONPATH"] = str(here.messages["5"] / "python")
        echoes = [
            asyncio.create_task(here.tools.run("rostopic", "echo", "-n", "1", f"{below}/{name}"))
            for name in ("added_order", "added_pending_transaction")
        ]
        said = (OrderFeedback(order="ab" * 32, accepted=1, signature="cd" * 65), TransactionFeedback(tx="ef" * 32))

        async def is_printed() -> bool:
            for message in said:
                network.session.put(
                    market_selector(here.place.market.deployment.lighthouse_name, message.kind), encode(message)
                )
            return all(echo.done() for echo in echoes)

        await until_found(is_printed, what="both messages")
        order, transaction = [await echo for echo in echoes]
        assert "order: [171, 171," in order
        assert 'uint256: "1"' in order
        assert f'txhash: "{"ef" * 32}"' in transaction


async def test_the_graph_has_the_names_of_the_legacy_documentation(scene: Opened) -> None:
    """Chapter 2: what `rosnode list` and `rostopic list` printed."""
    async with scene(open_services=False, is_alone=True) as here:
        nodes, topics = await asyncio.gather(here.tools.run("rosnode", "list"), here.tools.run("rostopic", "list"))
    assert set(nodes.split()) >= CHAPTER_2_NODES
    assert set(topics.split()) >= CHAPTER_2_TOPICS


CHAPTER_2_NODES = {
    "/eth/erc20_token",
    "/eth/eth_node",
    "/liability/executor",
    "/liability/infochan/channel",
    "/liability/infochan/signer",
    "/liability/listener",
    "/rosout",
}
CHAPTER_2_TOPICS = {
    "/eth/event/approval",
    "/eth/event/transfer",
    "/liability/complete",
    "/liability/finalized",
    "/liability/incoming",
    "/liability/infochan/eth/sending/demand",
    "/liability/infochan/eth/signing/offer",
    "/liability/infochan/incoming/result",
    "/liability/ready",
    "/liability/result",
    "/rosout",
    "/rosout_agg",
}


async def test_a_job_survives_a_restart_of_the_ros_master(
    place: Place, rosmaster: RosMasterServer, ros: Callable[[str], Ros], messages: dict[str, Path]
) -> None:
    """Connections go on meanwhile, and the services are registered again for the node that ends the job."""
    robot, graph = place.agent("robot", open_services=True), Ros1Graph(rosmaster.uri)
    async with (
        asyncio.timeout(60),
        place.at_work(robot) as person,
        bridged(place, robot, graph),
        ros(rosmaster.uri).node("blink", "Empty", "told", messages=messages["3"]) as node,
    ):
        assert await node.hear() == "ready"
        contract = await person.demand([("/blink", Empty())])
        assert await node.hear() == {"started": True}
        assert await node.hear() == {"blink": "on"}
        rosmaster.kill()
        await asyncio.to_thread(rosmaster.start)

        async def is_registered() -> bool:
            with suppress(Ros1Error):
                return bool(await graph.call("lookupService", "/liability/finish"))
            return False

        await until_found(is_registered, what="the services on the new master")
        node.tell("go on")
        assert (await contract.outcome()).success


async def test_the_player_of_bags_plays_and_records(scene: Opened, tmp_path: Path) -> None:
    """A bag that a node added is played below a namespace; what is published there becomes a recording."""
    bag = Bag([BagMessage("/say", String("hello").encode(), 1)]).encode()
    (tmp_path / "say.bag").write_bytes(bag)
    async with (
        scene(folders=(tmp_path,)) as here,
        Ros1Node(Ros1Graph(here.graph.master), "/test") as node,
        here.node("echo", "/played/say", "/played/answer"),
    ):
        kinds = {name: next(iter(versions.values())) for name, versions in service_types().items()}
        add, new, start, stop = (
            kinds[f"ipfs_common/{name}" if name.startswith("Ipfs") else f"robonomics_liability/{name}"]
            for name in ("IpfsUploadFile", "CreateRosbagPlayer", "StartRosbagPlayer", "StopRosbagPlayer")
        )
        added = await node.call("/ipfs/add_file", add, {"file": str(tmp_path / "say.bag")})
        assert added["success"], added["error_msg"]
        refused = await node.call("/ipfs/add_file", add, {"file": "/etc/hostname"})
        assert not refused["success"]
        made = await node.call("/rosbagplayer/new", new, {**added, "namespace": "/played"})
        assert made["success"], made["error_msg"]
        assert (await node.call("/rosbagplayer/start", start, made))["success"]
        await asyncio.sleep(1.0)  # it is recorded until it is stopped
        stopped = await node.call("/rosbagplayer/stop", stop, {**made, "success": True})
        recording = open_objective(await here.person.fetch(plain(stopped["ipfs_address"])))
        assert [(one.topic, one.value) for one in recording.messages()] == [("/say", "hello"), ("/answer", "hello")]


async def test_a_board_on_an_edge_agent_hears_a_node_of_ros(scene: Opened) -> None:
    """The lesson's firmware in a simulated Uno: the node publishes /blink_led, as to a board on rosserial."""
    async with (
        scene(recording_topics=frozenset({"/blink_led"})) as here,
        here.node("blink", "Empty", "board"),
    ):
        with ExitStack() as stack:
            uno = stack.enter_context(board("examples/blink/blink_rosserial"))
            serial = edge(uno.port, here.robot.address, here.place.endpoint, "--protocol", "rosserial")
            await asyncio.to_thread(stack.enter_context, serial)
            contract = await here.person.demand([("/blink", Empty())])
            assert (await contract.outcome()).success
            assert [change.high for change in uno.changes(13)][-6:] == [True, False] * 3
        assert ("/blink_led", "std_msgs/Empty", "") in await recorded(contract)
