"""Services and parameters of other ROS 2 systems, in both directions."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ros2 import RosError
from tests.support.ros2.definitions import ADD_TWO_INTS, ros_types
from tests.support.ros2.peers import RosPeer, hiroz, sdk
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    import zenoh

    from bridges.ros2 import Robot
    from tests.support.routers import EmbeddedRouter

    OurRobot = Callable[..., AbstractAsyncContextManager[Robot]]

PEERS = pytest.mark.parametrize("peer", [hiroz, sdk], ids=["hiroz", "sdk"])
LARGE = (1 << 62) - 5


@PEERS
async def test_a_service_of_a_peer_is_called(
    peer: Callable[..., RosPeer], router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with peer("add-server", router.endpoint) as server, our_robot() as robot:
        for number in range(3):
            reply = await robot.call("/add_two_ints", ADD_TWO_INTS, {"a": number, "b": LARGE}, timeout=20)
            assert reply.sum == number + LARGE
            assert await server.line("a") == number
        assert server.is_alive


@PEERS
async def test_a_peer_calls_a_service_of_ours(
    peer: Callable[..., RosPeer], router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async def add(request: Any) -> dict[str, int]:
        return {"sum": request.a + request.b}

    async with our_robot() as robot:
        robot.serve("/add_two_ints", ADD_TWO_INTS, add)
        async with peer("add-client", router.endpoint, a=-3, b=LARGE) as client:
            assert await client.rest() == [{"sum": LARGE - 3}]


async def test_many_calls_at_a_time_get_their_own_replies(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with hiroz("add-server", router.endpoint), our_robot() as robot:
        calls = [robot.call("/add_two_ints", ADD_TWO_INTS, {"a": a, "b": 1}, timeout=20) for a in range(8)]
        assert [reply.sum for reply in await asyncio.gather(*calls)] == [a + 1 for a in range(8)]


async def test_services_of_a_distribution_without_hashes(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async def subtract(request: Any) -> dict[str, int]:
        return {"sum": request.a - request.b}

    types = ros_types("humble")
    async with hiroz("add-server", router.endpoint, distribution="humble"), our_robot(types) as robot:
        assert (await robot.call("/add_two_ints", ADD_TWO_INTS, {"a": 1, "b": 2}, timeout=20)).sum == 3
        robot.serve("/subtract", ADD_TWO_INTS, subtract)
        options = {"distribution": "humble", "service": "/subtract", "a": 9, "b": 4}
        async with hiroz("add-client", router.endpoint, **options) as client:
            assert await client.rest() == [{"sum": 5}]


async def test_a_failed_request_of_a_peer_ends_and_leaves_the_peer_alive(
    router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async def fail(request: Any) -> dict[str, int]:
        raise ValueError(request.a)

    async with our_robot() as robot:
        robot.serve("/add_two_ints", ADD_TWO_INTS, fail)
        async with hiroz("add-client", router.endpoint, timeout=2000) as client:
            (line,) = await client.rest()
            assert "failed" in line


async def test_a_call_ends_when_its_server_dies(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with our_robot() as robot:
        async with hiroz("add-server", router.endpoint):
            await robot.ready("/add_two_ints")
        # Whether the graph knows that already is left to chance.
        with pytest.raises(RosError):
            await robot.call("/add_two_ints", ADD_TWO_INTS, {"a": 1, "b": 2}, timeout=1)


async def test_parameters_of_a_peer_are_listed_read_and_set(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with hiroz("parameters", router.endpoint, node="configured") as peer, our_robot() as robot:
        await robot.ready("/configured/list_parameters")
        parameters = robot.parameters("/configured", timeout=20)
        assert sorted(await parameters.list()) == ["active", "frame", "gains", "names", "rate", "speed"]
        assert await parameters.get("rate") == 10
        assert await parameters.get("speed") == 0.5
        assert await parameters.get("frame") == "map"
        assert await parameters.get("active") is True
        assert list(await parameters.get("gains")) == [1.0, 2.5]
        assert list(await parameters.get("names")) == ["a", "bc"]
        await parameters.set(rate=25)
        assert await peer.line("set") == "rate"
        assert await parameters.get("rate") == 25
        with pytest.raises(RosError, match="rate is negative"):
            await parameters.set(rate=-1)
        assert await parameters.get("rate") == 25


async def test_a_peer_lists_reads_and_sets_parameters_of_ours(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with our_robot() as robot:
        values = robot.declare_parameters({"rate": 10, "frame": "map"})
        async with hiroz("parameter-client", router.endpoint, target="/aira", value=20) as peer:
            assert sorted(await peer.line("names")) == ["frame", "rate"]
            assert "10" in await peer.line("value")
            assert await peer.line("successful") is True
            assert "20" in await peer.line("value")
        assert values == {"rate": 20, "frame": "map"}


async def test_a_peers_change_of_a_parameter_is_heard(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with hiroz("parameters", router.endpoint, node="configured"), our_robot() as robot:
        kind = "rcl_interfaces/msg/ParameterEvent"
        async with robot.subscribe("/parameter_events", kind) as events:
            await robot.ready("/configured/set_parameters")
            await robot.parameters("/configured", timeout=20).set(speed=2.5)
            async with asyncio.timeout(30):
                async for event in events:
                    changed = robot.types.decode(kind, event.payload.data).changed_parameters
                    if changed:
                        break
        assert [(one.name, one.value.double_value) for one in changed] == [("speed", 2.5)]


@pytest.mark.parametrize("attachment", [None, b"", bytes(32), bytes(34), bytes(16) + b"\x20" + bytes(16)])
async def test_a_request_with_a_malformed_attachment_is_refused_and_harms_nothing(
    attachment: bytes | None, router: EmbeddedRouter, our_robot: OurRobot, there: zenoh.Session
) -> None:
    async def add(request: Any) -> dict[str, int]:
        return {"sum": request.a + request.b}

    async with our_robot() as robot:
        robot.serve("/add_two_ints", ADD_TWO_INTS, add)
        key = f"0/add_two_ints/*/{robot.types.type_hash(ADD_TWO_INTS)}"
        request = robot.types.message(f"{ADD_TWO_INTS}_Request", a=1, b=2).data

        def ask() -> list[Any]:
            return list(there.get(key, payload=request, attachment=attachment, timeout=20.0))

        await until(lambda: robot.graph.services(), what="our service")
        replies = await asyncio.to_thread(ask)
        assert [reply.ok for reply in replies] in ([], [None])
        async with hiroz("add-client", router.endpoint) as client:
            assert await client.rest() == [{"sum": 5}]
