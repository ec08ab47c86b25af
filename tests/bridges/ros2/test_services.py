"""Services and parameters, between two nodes of ours on a real router."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import pytest

from bridges.ros2 import Robot, RosAllowed, RosEntity, RosError
from bridges.ros2._services import from_value, to_value
from bridges.ros2._wire import RmwZenoh, RosAttachment, parse_attachment
from mesh import InvalidPayload, RosTypes
from mesh.base.flood import Drops
from mesh.errors import ConfigurationError
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    import zenoh

ADD: Final = "example_interfaces/AddTwoInts"
ADD_FULL: Final = "example_interfaces/srv/AddTwoInts"
DEFINITION: Final = "int64 a\nint64 b\n---\nint64 sum\n"


@pytest.fixture
def ros() -> RosTypes:
    types = RosTypes("jazzy")
    types.register(ADD, DEFINITION)
    return types


class Recorded:
    """What a job would record."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, Any]] = []

    def publish(self, topic: str, message: object) -> None:
        self.messages.append((topic, message))


async def add(request: Any) -> dict[str, int]:
    return {"sum": request.a + request.b}


@pytest.mark.parametrize("flavour", ["rmw_zenoh", "ros2dds"])
@pytest.mark.parametrize("distribution", ["jazzy", "humble"])
async def test_a_service_is_called(
    here: zenoh.Session, there: zenoh.Session, domain: int, flavour: Any, distribution: str
) -> None:
    ros, job = RosTypes(distribution), Recorded()
    ros.register(ADD, DEFINITION)
    name = f"/add{domain}"
    async with (
        Robot(here, ros, domain=domain, flavour=flavour) as ours,
        Robot(there, ros, domain=domain, node="server", flavour=flavour) as server,
    ):
        server.serve(name, ADD, add)
        replies = [await ours.call(name, ADD, {"a": 1, "b": number}, job=job) for number in range(3)]

        assert ours.graph.services() == {name: [ADD_FULL]}
    assert [reply.sum for reply in replies] == [1, 2, 3]
    assert [topic for topic, _ in job.messages][:2] == [f"{name}/_request", f"{name}/_reply"]
    assert job.messages[1][1].type == ros.payload_type(f"{ADD_FULL}_Response")


async def test_request_and_reply_are_those_of_rmw_zenoh(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    import zenoh

    key = RmwZenoh(domain).key("/add", ADD_FULL, ros.type_hash(ADD_FULL))
    gid = b"g" * 16
    async with Robot(there, ros, domain=domain, node="server") as server, Robot(here, ros, domain=domain) as ours:
        server.serve("/add", ADD, add)
        await ours.ready("/add")
        request = ros.message(f"{ADD_FULL}_Request", a=2, b=3).data

        def ask(attachment: bytes | None) -> list[zenoh.Reply]:
            options: dict[str, Any] = {} if attachment is None else {"attachment": attachment}
            return list(here.get(key, payload=request, timeout=30, target=zenoh.QueryTarget.ALL_COMPLETE, **options))

        (reply,) = await asyncio.to_thread(ask, RosAttachment(7, 1, gid).encode())
        (refused,) = await asyncio.to_thread(ask, None)

    assert reply.ok is not None
    assert reply.ok.payload.to_bytes().hex() == "000100000500000000000000"
    attached = parse_attachment(reply.ok.attachment.to_bytes())  # type: ignore[union-attr]
    assert attached is not None
    assert (attached.sequence, attached.gid) == (7, gid)
    assert attached.time_ns > 1
    assert refused.err is not None
    assert server.drops.totals() == {"bad-request": 1}


async def test_a_reply_to_another_request_is_not_taken(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    drops = Drops()
    others = [RosAttachment(99, 1, b"g" * 16).encode(), RosAttachment(4, 1, b"g" * 16).encode()]
    wrong = iter([None, b"\0" * 33, *others])

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, ros.message(f"{ADD_FULL}_Response", sum=1).data, attachment=next(wrong))

    key = RmwZenoh(domain).key("/add", ADD_FULL, ros.type_hash(ADD_FULL))
    type_hash = ros.type_hash(ADD_FULL)
    shown = RosEntity("server", domain, "ab", 1, 2, "server", name="/add", type=ADD_FULL, type_hash=type_hash)
    with (
        there.declare_queryable(key, answer, complete=True),
        there.liveliness().declare_token(RmwZenoh(domain).token(shown)),
    ):
        async with Robot(here, ros, domain=domain, drops=drops) as ours:
            for _ in range(4):
                with pytest.raises(RosError):
                    await ours.call("/add", ADD, {}, timeout=5)

    assert drops.totals() == {"bad-reply": 4}


async def test_a_missing_server_a_silent_one_and_a_failing_one(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    async def never(request: Any) -> None:
        await asyncio.Event().wait()

    async def fail(request: Any) -> None:
        raise RuntimeError("as planned")

    async with (
        Robot(here, ros, domain=domain) as ours,
        Robot(there, ros, domain=domain, node="server") as server,
    ):
        server.serve("/never", ADD, never)
        server.serve("/fail", ADD, fail)
        with raises_with(RosError, code="ros-unavailable"):
            await ours.call("/missing", ADD, {}, timeout=0.1)
        with pytest.raises(RosError):
            await ours.call("/never", ADD, {}, timeout=0.3)
        with pytest.raises(RosError):
            await ours.call("/fail", ADD, {}, timeout=20)
        with raises_with(RosError, code="ros-type-mismatch"):
            await ours.call("/fail", "std_srvs/Trigger", {})
        with pytest.raises(InvalidPayload):
            await ours.call("/fail", ADD, {"a": "text"})


async def test_requests_too_many_get_an_error_reply(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    drops, go = Drops(), asyncio.Event()

    async def wait(request: Any) -> None:
        await go.wait()

    async with (
        Robot(here, ros, domain=domain) as ours,
        Robot(there, ros, domain=domain, node="server", drops=drops) as server,
    ):
        server.serve("/wait", ADD, wait, limit=2)
        calls = [asyncio.create_task(ours.call("/wait", ADD, {}, timeout=20)) for _ in range(3)]
        await until(lambda: drops.totals() == {"request": 1})
        go.set()
        results = await asyncio.gather(*calls, return_exceptions=True)

    assert sorted(type(result).__name__ for result in results).count("RosError") == 1


async def test_services_must_be_allowed(here: zenoh.Session, domain: int, ros: RosTypes) -> None:
    async with Robot(here, ros, domain=domain, allow=RosAllowed(call=("/spawn", "/talker"))) as ours:
        ours.parameters("/talker")
        with raises_with(ConfigurationError, code="ros-not-allowed") as called:
            await ours.call("/add", ADD, {})
        with raises_with(ConfigurationError, code="ros-not-allowed"):
            ours.parameters("/other")
        with raises_with(ConfigurationError, code="ros-not-allowed"):
            ours.serve("/spawn", ADD, add)
    assert str(called.value) == "/add: not allowed to call"


VALUES: Final[dict[str, Any]] = {
    "flag": True,
    "count": 3,
    "rate": 2.5,
    "name": "it",
    "raw": b"\1\2",
    "flags": [True, False],
    "counts": [1, 2],
    "rates": [0.5, 1.5],
    "names": ["a", "b"],
}


async def test_our_own_parameters_keep_their_types_and_may_be_refused(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    def refusal(name: str, value: Any) -> str:
        return "too fast" if name == "rate" and value > 50 else ""

    async with (
        Robot(there, RosTypes("jazzy"), domain=domain, node="lamp", namespace="/room") as theirs,
        Robot(here, ros, domain=domain) as ours,
    ):
        held = theirs.declare_parameters({"rate": 10, "camera.gain": 0.5, "camera.name": "front"}, refusal=refusal)
        parameters = ours.parameters("/room/lamp")
        assert await parameters.list() == ("rate", "camera.gain", "camera.name")
        assert await parameters.get_all("rate", "camera.name") == {"rate": 10, "camera.name": "front"}
        assert await parameters.get("missing") is None
        await parameters.set(rate=20, **{"camera.gain": 1.5})
        for wrong, why in (({"rate": 51}, "too fast"), ({"rate": 0.5}, "type"), ({"missing": 1}, "no parameter")):
            with pytest.raises(RosError, match=why):
                await parameters.set(**wrong)
        assert held == {"rate": 20, "camera.gain": 1.5, "camera.name": "front"}
        kind = "rcl_interfaces/SetParametersAtomically"
        changes = [{"name": name, "value": to_value(value)} for name, value in (("rate", 30), ("camera.gain", "no"))]
        reply = await ours.call("/room/lamp/set_parameters_atomically", kind, {"parameters": changes})
        assert not reply.result.successful
        assert held["rate"] == 20
        found = await ours.call(
            "/room/lamp/describe_parameters", "rcl_interfaces/DescribeParameters", {"names": ["rate"]}
        )
        assert [(one.name, one.type) for one in found.descriptors] == [("rate", 2)]
        listed = await ours.call(
            "/room/lamp/list_parameters", "rcl_interfaces/ListParameters", {"prefixes": ["camera"]}
        )
        assert (listed.result.names, listed.result.prefixes) == (["camera.gain", "camera.name"], ["camera"])


async def test_parameters_are_listed_read_and_set(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    held: dict[str, Any] = {"rate": ros.type("rcl_interfaces/ParameterValue")}
    held.clear()

    async def get(request: Any) -> dict[str, Any]:
        if not all(name in held for name in request.names):
            return {"values": []}
        return {"values": [held[name] for name in request.names]}

    async def put(request: Any) -> dict[str, Any]:
        results = []
        for parameter in request.parameters:
            refused = parameter.name == "fixed"
            results.append({"successful": not refused, "reason": "it is fixed" if refused else ""})
            if not refused:
                held[parameter.name] = parameter.value
        return {"results": results}

    async def list_(request: Any) -> dict[str, Any]:
        return {"result": {"names": list(held)}}

    async with (
        Robot(here, ros, domain=domain) as ours,
        Robot(there, ros, domain=domain, node="talker") as talker,
    ):
        for name, kind, handler in (
            ("get_parameters", "GetParameters", get),
            ("set_parameters", "SetParameters", put),
            ("list_parameters", "ListParameters", list_),
        ):
            talker.serve(f"~/{name}", f"rcl_interfaces/{kind}", handler)
        parameters = ours.parameters("/talker")
        await parameters.set(**VALUES)
        with pytest.raises(RosError) as refused:
            await parameters.set(fixed=1)

        assert await parameters.list() == tuple(VALUES)
        assert await parameters.get_all(*VALUES) == VALUES
        assert await parameters.get("rate") == 2.5
        assert await parameters.get("missing") is None
        assert await parameters.get_all("rate", "missing") == {"rate": 2.5, "missing": None}
    assert "it is fixed" in str(refused.value)


@pytest.mark.parametrize("value", [object(), [1, "a"], {"a": 1}, [[1]]])
def test_a_value_that_no_parameter_has_is_refused(value: object) -> None:
    with pytest.raises(InvalidPayload):
        to_value(value)


def test_a_value_of_an_unknown_type_is_none() -> None:
    ros = RosTypes("jazzy")
    value = ros.decode("rcl_interfaces/ParameterValue", ros.message("rcl_interfaces/ParameterValue", type=77).data)
    assert from_value(value) is None
