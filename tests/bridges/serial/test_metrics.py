"""The metrics and health of an edge agent: its line, its board, its calls."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from bridges.serial._device import Device
from bridges.serial.dialect import CallFailed
from schemas.status import ALIVE
from tests.support.boards import COUNTER, board, edge
from tests.support.commands import AIRA, Serving, aira
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.scraping import health, scraped
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.market import Place


LONG = 60.0
WELL = {"channel": ALIVE, "line": ALIVE, "board": ALIVE}


async def health_is(url: str, expected: tuple[int, dict[str, str]]) -> bool:
    return await health(url) == expected


async def test_calls_are_counted_by_their_outcome(place: Place) -> None:
    listen = f"127.0.0.1:{free_port()}"
    url = f"http://{listen}"
    with (
        board(COUNTER) as uno,
        edge(uno.port, place.address("robot"), place.endpoint, "--metrics-listen", listen),
    ):
        await until_found(lambda: health_is(url, (200, WELL)), what="the board", seconds=LONG)
        async with place.agent("robot") as robot:
            before = await scraped(url)
            assert (await Device(robot).call("/add", 5)).value == 5
            with raises_with(CallFailed, code="call-refused"):
                await Device(robot).call("/add", "five")
            after = await scraped(url)
        changes = after.changes(before)
        assert changes["aira_edge_calls_total{done}"] == 1
        assert changes["aira_edge_calls_total{refused}"] == 1
        assert changes["aira_edge_frames_total{out}"] >= 2
        assert changes["aira_edge_frames_total{in}"] >= 2
        assert after("aira_edge_board_present") == 1
        assert after("aira_edge_line_openings_total") == 1
        assert after("aira_edge_frame_faults_total", reason="damaged") == 0


async def test_a_lost_board_is_reported(place: Place) -> None:
    listen = f"127.0.0.1:{free_port()}"
    url = f"http://{listen}"
    with ExitStack() as stack:
        with board(COUNTER) as uno:
            options = ("--metrics-listen", listen)
            stack.enter_context(edge(uno.port, place.address("robot"), place.endpoint, *options))
            await until_found(lambda: health_is(url, (200, WELL)), what="the board", seconds=LONG)
        gone = {**WELL, "line": "waits for the port", "board": "is absent"}
        await until_found(lambda: health_is(url, (503, gone)), what="the loss", seconds=LONG)
        metrics = await scraped(url)
        assert (metrics("aira_edge_board_present"), metrics("aira_edge_board_losses_total")) == (0, 1)
        assert metrics("aira_part_up", part="board") == 0


async def test_an_edge_agent_that_waits_for_its_router_reports_that_it_starts(tmp_path: Path) -> None:
    listen, router = f"127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    options = ("--agent", "0x" + "11" * 20, "--connect", router, "--connect-timeout", "-1", "--metrics-listen", listen)
    with Serving(*AIRA, "edge", tmp_path / "port", *options, says="metrics at"):
        assert await health(f"http://{listen}") == (503, {"start": "still waits"})
        assert aira("health", "--url", f"http://{listen}").returncode == 1
