"""Metrics and health of a role in an event loop: before its start, while it works, and when the loop is blocked."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor as Threads
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ChainError, ClosedError, ConfigurationError
from mesh.telemetry.metrics import MetricFamily, counter, gauge, labelled
from mesh.telemetry.serving import Telemetry
from schemas.status import ALIVE
from tests.support.raising import raises_with
from tests.support.scraping import SECONDS, get, health, scraped
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

HERE = "127.0.0.1:0"
"""A free port."""


def measuring(name: str, value: float, **labels: str) -> Callable[[], Awaitable[Iterable[MetricFamily]]]:
    async def measure() -> Iterable[MetricFamily]:
        return labelled([gauge(name, "Of the test", value)], **labels)

    return measure


async def test_without_an_address_nothing_is_served() -> None:
    async with Telemetry("") as telemetry:
        with telemetry.showing(measure=measuring("aira_a", 1), health=lambda: {"part": ALIVE}):
            assert telemetry.url == ""


async def test_a_role_that_has_not_started_is_unhealthy_and_says_what_it_waits_for() -> None:
    async with Telemetry(HERE) as telemetry:
        assert await health(telemetry.url) == (503, {"start": "still waits"})
        telemetry.starting("no router answers")
        assert await health(telemetry.url) == (503, {"start": "waits: no router answers"})
        figures = await scraped(telemetry.url)
        assert figures("aira_part_up", part="start") == 0
        with telemetry.showing(health=lambda: {"channel": ALIVE}):
            assert await health(telemetry.url) == (200, {"channel": ALIVE})
        assert (await health(telemetry.url))[0] == 503


async def test_several_roles_of_one_process_are_served_together() -> None:
    async with Telemetry(HERE) as telemetry:
        with (
            telemetry.showing(measure=measuring("aira_a", 1, lighthouse="north"), health=lambda: {"north": ALIVE}),
            telemetry.showing(measure=measuring("aira_a", 2, lighthouse="south"), health=lambda: {"south": "waits"}),
        ):
            figures = await scraped(telemetry.url)
            assert (figures("aira_a", lighthouse="north"), figures("aira_a", lighthouse="south")) == (1, 2)
            assert (figures("aira_part_up", part="north"), figures("aira_part_up", part="south")) == (1, 0)
            assert await health(telemetry.url) == (503, {"north": ALIVE, "south": "waits"})


async def test_each_scrape_measures_again() -> None:
    count = 0

    async def measure() -> Iterable[MetricFamily]:
        nonlocal count
        count += 1
        return [counter("aira_scrapes_total", "Scrapes", count)]

    async with Telemetry(HERE) as telemetry:
        with telemetry.showing(measure=measure, health=dict):
            for expected in (1, 2, 3):
                assert (await scraped(telemetry.url))("aira_scrapes_total") == expected


async def test_a_blocked_event_loop_is_unhealthy_and_requests_do_not_wait_for_it() -> None:
    async with Telemetry(HERE, answer_timeout=0.2) as telemetry:
        with telemetry.showing(measure=measuring("aira_a", 1), health=lambda: {"channel": ALIVE}), Threads() as threads:
            asked = [threads.submit(get, telemetry.url, path) for path in ("/health", "/metrics")]
            # Wait in the event loop itself, like a handler that blocks it.
            of_health, of_metrics = [asking.result(SECONDS) for asking in asked]
            assert (of_health.status, of_metrics.status) == (503, 503)
            assert "event loop" in of_health.text

            async def is_well() -> bool:
                return await health(telemetry.url) == (200, {"channel": ALIVE})

            await until_found(is_well, what="the loop's answer")


async def test_an_expected_error_of_a_measurement_is_503(caplog: pytest.LogCaptureFixture) -> None:
    async def measure() -> Iterable[MetricFamily]:
        raise ChainError("the ledger is full")

    async with Telemetry(HERE) as telemetry:
        with telemetry.showing(measure=measure, health=lambda: {"channel": ALIVE}):
            page = await asyncio.to_thread(get, telemetry.url, "/metrics")
            assert (page.status, page.text) == (503, "unavailable; the server's log says why\n")
    assert "the ledger is full" in caplog.text


async def test_a_role_closed_during_a_scrape_has_no_metrics_and_is_no_failure(
    caplog: pytest.LogCaptureFixture,
) -> None:
    began, closed = asyncio.Event(), asyncio.Event()

    async def measure() -> Iterable[MetricFamily]:
        began.set()
        await closed.wait()
        raise ClosedError("the store is closed")

    async with Telemetry(HERE) as telemetry:
        with telemetry.showing(measure=measure, health=lambda: {"channel": ALIVE}):
            asked = asyncio.create_task(asyncio.to_thread(get, telemetry.url, "/metrics"))
            await began.wait()
        closed.set()
        page = await asked
        assert (page.status, "aira_part_up" in page.text) == (200, True)
    assert caplog.records == []


async def test_a_request_cancelled_by_the_end_of_the_program_is_no_failure(caplog: pytest.LogCaptureFixture) -> None:
    async def measure() -> Iterable[MetricFamily]:
        task = asyncio.current_task()
        assert task is not None
        task.cancel()
        await asyncio.sleep(0)
        return ()

    async with Telemetry(HERE) as telemetry:
        with telemetry.showing(measure=measure, health=lambda: {"channel": ALIVE}):
            page = await asyncio.to_thread(get, telemetry.url, "/metrics")
            assert page.status == 503
    assert [record.exc_info for record in caplog.records] == [None]


def test_a_request_after_the_end_of_the_loop_is_no_failure(caplog: pytest.LogCaptureFixture) -> None:
    telemetry = Telemetry(HERE)
    asyncio.run(telemetry.__aenter__())
    page = get(telemetry.url, "/health")
    asyncio.run(telemetry.__aexit__(None, None, None))
    assert page.status == 503
    assert [record.exc_info for record in caplog.records] == [None]


async def test_two_servers_can_not_share_a_port() -> None:
    async with Telemetry(HERE) as telemetry:
        with raises_with(ConfigurationError, code="metrics-not-served"):
            await Telemetry(telemetry.url.removeprefix("http://")).__aenter__()


LOADED = """
import asyncio, sys
{what}
names = ("prometheus_client", "http.server", {more})
print(sorted(name for name in names if name in sys.modules))
"""


@pytest.mark.parametrize(
    ("what", "more"),
    [
        ("from mesh.telemetry.serving import Telemetry\nasyncio.run(Telemetry('').__aenter__())", ""),
        ("import mesh.agent.agent, mesh.agent._runtime", ""),
        ("import mesh.market.provider", ""),
        ("import mesh.cli.provider, mesh.cli.router, mesh.cli.up", ""),
        (
            "from bridges.serial._edge import Edge, EdgeOptions, serve_metrics\n"
            "edge = Edge(EdgeOptions(agent='0x' + '11' * 20, port='/dev/tty'))\n"
            "with serve_metrics(edge, ''): pass",
            '"web3", "aiohttp"',
        ),
    ],
)
def test_without_metrics_the_server_is_not_loaded(what: str, more: str) -> None:
    program = LOADED.format(what=what, more=more)

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)

    assert done.stdout == "[]\n"
