"""Sessions: opening, its errors, closing, and reconnection after the router was away."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import time
from contextlib import aclosing, closing
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.errors import ClosedError, ConfigurationError, NetworkUnavailable
from mesh.network import Endpoints, Network, NetworkChange
from tests.support.ports import free_endpoint
from tests.support.raising import raises_with
from tests.support.routers import EmbeddedRouter
from tests.support.waiting import at_most, until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.routers import Zenohd


def client(*connect: str, timeout: float = 10.0) -> Network:
    return Network(Endpoints(connect=connect, timeout=timeout))


async def next_change(changes: AsyncIterator[NetworkChange]) -> NetworkChange:
    async with asyncio.timeout(60):
        return await anext(changes)


async def test_a_client_opens_and_closes(router: EmbeddedRouter) -> None:
    network = client(router.endpoint)

    async with network:
        session = network.session
        assert not session.is_closed()
        assert network.connected
        assert network.id == str(session.zid())

    assert session.is_closed()
    assert not network.connected


async def test_a_missing_router_is_reported_with_a_hint() -> None:
    endpoint = free_endpoint()

    with at_most(2), pytest.raises(NetworkUnavailable) as error:
        async with client(endpoint, timeout=0.5):
            pass

    assert error.value.code == "network-unavailable"
    assert "aira router" in error.value.hint
    assert error.value.endpoints == (endpoint,)


async def test_a_host_that_accepts_but_never_answers_times_out() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as mute, at_most(3), pytest.raises(NetworkUnavailable):
        async with client(f"tcp/127.0.0.1:{mute.getsockname()[1]}", timeout=0.5):
            pass


@pytest.mark.parametrize("timeout", [20, -1])
async def test_a_client_waits_for_a_router_that_starts_later(timeout: float) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as somebody_else:
        port = somebody_else.getsockname()[1]
        network = client(f"tcp/127.0.0.1:{port}", timeout=timeout)
        opening = asyncio.create_task(network.__aenter__())
        first_attempt, _ = await asyncio.to_thread(somebody_else.accept)
        first_attempt.close()

    with EmbeddedRouter(port):
        async with asyncio.timeout(60):
            await opening
        assert network.connected
        await network.__aexit__(None, None, None)


async def test_the_second_of_two_routers_is_used(router: EmbeddedRouter) -> None:
    async with client(free_endpoint(), router.endpoint) as network:
        assert network.connected


@pytest.mark.parametrize(
    "locator",
    [
        "127.0.0.1:7447",
        "tcp/",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/127.0.0.1:http",
        "tcp/127.0.0.1:65536",
        "tcp/127.0.0.1:7447 ",
        "http/127.0.0.1:80",
        "tcp//127.0.0.1:80",
        "",
    ],
)
async def test_an_invalid_locator_is_rejected(locator: str) -> None:
    with at_most(1), pytest.raises(ConfigurationError) as error:
        async with client(locator):
            pass

    assert str(error.value) == f"{locator!r} is not a Zenoh endpoint"
    assert "tcp/HOST:PORT" in error.value.hint


@pytest.mark.parametrize(
    "locator",
    ["tcp/localhost:7447", "tcp/[::1]:7447", "udp/127.0.0.1:1", "ws/h:1", "unixsock-stream//tmp/socket",
     "tcp/127.0.0.1:7447#iface=lo"],
)  # fmt: skip
def test_zenohs_locators_are_accepted(locator: str) -> None:
    Endpoints(connect=(locator,)).config()
    Endpoints(mode="router", listen=(locator,)).config()


async def test_a_client_without_a_locator_is_rejected() -> None:
    with pytest.raises(ConfigurationError):
        async with client():
            pass


async def test_a_taken_port_is_reported() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        listen = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with raises_with(ConfigurationError, code="listen-failed") as error:
            async with Network(Endpoints(mode="router", listen=(listen,))):
                pass

    assert listen in str(error.value)
    assert str(error.value) == f"can't listen at {listen}: Address already in use (os error 98)"
    assert "--listen" in error.value.hint


async def test_a_router_is_usable_at_once_without_others() -> None:
    took = list[float]()
    # What else goes on on the machine may make some of them slow, and hardly all.
    while len(took) < 20 and min(took, default=1.0) >= 0.4:
        begun, endpoint = time.monotonic(), free_endpoint()
        async with Network(Endpoints(mode="router", listen=(endpoint,))) as router, client(endpoint) as network:
            assert router.connected
            assert network.connected
        took.append(time.monotonic() - begun)
    assert min(took) < 0.4


async def test_the_session_exists_only_inside_async_with(router: EmbeddedRouter) -> None:
    network = client(router.endpoint)
    with pytest.raises(ClosedError):
        network.session  # noqa: B018

    async with network:
        with pytest.raises(ClosedError):
            await network.__aenter__()

    with pytest.raises(ClosedError):
        network.id  # noqa: B018


async def test_a_network_can_be_opened_again(router: EmbeddedRouter) -> None:
    network = client(router.endpoint)

    for _ in range(2):
        async with network:
            assert network.connected


async def test_loss_and_return_of_the_router_are_reported_and_subscriptions_are_restored(zenohd: Zenohd) -> None:
    heard: list[str] = []
    async with client(zenohd.endpoint) as network, client(zenohd.endpoint) as other:
        with other.session.declare_subscriber("test/**", lambda sample: heard.append(str(sample.key_expr))):
            await until_heard(network.session, "test/before")
            async with aclosing(network.changes()) as changes:
                change = asyncio.create_task(next_change(changes))
                await asyncio.sleep(0)

                await asyncio.to_thread(zenohd.kill)
                assert (await change, network.connected) == (NetworkChange.LOST, False)

                await asyncio.to_thread(zenohd.start)
                assert (await next_change(changes), network.connected) == (NetworkChange.REGAINED, True)

            await until_heard(network.session, "test/after")
            network.session.put("test/after", b"")
            await until(lambda: heard == ["test/after"])


async def test_each_watcher_is_notified() -> None:
    router = EmbeddedRouter()
    with router:
        async with (
            client(router.endpoint) as network,
            aclosing(network.changes()) as one,
            aclosing(network.changes()) as two,
        ):
            waiting = [asyncio.create_task(next_change(changes)) for changes in (one, two)]
            await asyncio.sleep(0)
            router.stop()
            assert await asyncio.gather(*waiting) == [NetworkChange.LOST] * 2


async def test_a_second_router_takes_over_when_the_first_is_gone() -> None:
    with EmbeddedRouter() as first, EmbeddedRouter() as second:
        async with (
            client(first.endpoint, second.endpoint) as network,
            client(second.endpoint) as other,
            aclosing(network.changes()) as changes,
        ):
            change = asyncio.create_task(next_change(changes))
            await asyncio.sleep(0)
            first.stop()

            assert [await change, await next_change(changes)] == [NetworkChange.LOST, NetworkChange.REGAINED]
            heard: list[str] = []
            with other.session.declare_subscriber("test", lambda sample: heard.append(str(sample.key_expr))):
                await until_heard(network.session, "test")
                network.session.put("test", b"")
                await until(lambda: heard == ["test"])


async def test_cancelling_the_opening_takes_effect_at_once() -> None:
    opening = asyncio.create_task(client(free_endpoint(), timeout=-1).__aenter__())
    await asyncio.sleep(0)

    opening.cancel()

    with at_most(1.5), pytest.raises(asyncio.CancelledError):
        await opening


async def test_a_session_that_opens_after_its_cancellation_is_closed(router: EmbeddedRouter) -> None:
    opened: set[str] = set()
    closed: set[str] = set()
    cancelled = 0

    def changed(event: zenoh.TransportEvent) -> None:
        (opened if event.kind == zenoh.SampleKind.PUT else closed).add(str(event.transport.zid))

    assert router.session is not None
    listener = router.session.info.declare_transport_events_listener(changed)
    async with asyncio.timeout(60):
        while len(opened) < 3 or cancelled < 3:
            network = client(router.endpoint)
            opening = asyncio.create_task(network.__aenter__())
            await asyncio.sleep(0)
            opening.cancel()
            try:
                await opening
            except asyncio.CancelledError:
                cancelled += 1
            else:  # a busy machine opened it before
                await network.__aexit__(None, None, None)

    await until(lambda: opened == closed, what="the end of each session")
    listener.undeclare()  # type: ignore[no-untyped-call]


WAITS_FOR_EVER = """
import asyncio
from mesh.network import Endpoints, Network

async def main():
    asyncio.get_running_loop().call_later(0.2, asyncio.current_task().cancel)
    async with Network(Endpoints(connect=("tcp/127.0.0.1:9",), timeout=-1)):
        pass

try:
    asyncio.run(main())
except asyncio.CancelledError:
    print("cancelled")
"""


async def test_a_process_that_is_stopped_while_it_waits_for_a_router_ends() -> None:
    with at_most(10):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", WAITS_FOR_EVER, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        async with asyncio.timeout(60):
            out, _ = await process.communicate()

    assert (out, process.returncode) == (b"cancelled\n", 0)


async def test_a_router_admits_no_more_sessions_than_it_may() -> None:
    endpoint = free_endpoint()
    async with (
        Network(Endpoints(mode="router", listen=(endpoint,), max_sessions=2)),
        client(endpoint),
        client(endpoint),
    ):
        with pytest.raises(NetworkUnavailable):
            await client(endpoint, timeout=1).__aenter__()


LOCKED = """
import asyncio
from pathlib import Path
from mesh.network import Endpoints, Network, free_endpoint

async def main() -> None:
    at = free_endpoint()
    async with (
        Network(Endpoints(mode="router", listen=(at,), shared_memory=SHARED)),
        Network(Endpoints(connect=(at,), shared_memory=SHARED)),
    ):
        (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck"))
        print(line.split()[1])

asyncio.run(main())
"""


@pytest.mark.parametrize("shared", [False, True])
def test_a_session_locks_memory_only_if_it_shares_memory(shared: bool) -> None:
    script = LOCKED.replace("SHARED", str(shared))
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert (int(ran.stdout) > 0) == shared
