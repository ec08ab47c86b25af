from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from bridges.ipfs.report import figures_of, news
from schemas.status import ContentMetrics
from tests.bridges.ipfs.bridges import bridging, on_mesh, until_seen
from tests.bridges.ipfs.statuses import status, way
from tests.support.orders import demand
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from tests.support.routers import EmbeddedRouter


def test_only_what_is_new_is_said() -> None:
    before = figures_of(status(to_ipfs=way(carried=3, waiting=2, invalid={"key": 1})))
    now = figures_of(status(to_ipfs=way(carried=5, invalid={"key": 1, "signature": 4}), losses=1))
    assert news(before, now) == "losses=+1 to_ipfs.invalid.signature=+4 to_ipfs.carried=+2 to_ipfs.waiting=0"
    assert news(now, now) == ""


def test_content_is_counted_too() -> None:
    content = ContentMetrics(
        fetched=1, fetched_bytes=100, lies=0, answered=0, added=0, added_bytes=0, by_blocks=0, pinned=0, failed=0
    )
    assert news({}, figures_of(status(content=content))) == "content.fetched=+1 content.fetched_bytes=+100"


async def test_a_flood_is_one_line_of_the_log_and_what_is_lost_a_warning(
    router: EmbeddedRouter, topic: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "bridges.ipfs.channel")
    api = f"http://127.0.0.1:{free_port()}"

    def said() -> list[logging.LogRecord]:
        return [record for record in caplog.records if record.name == "bridges.ipfs.channel"]

    async with (
        on_mesh(router.endpoint, topic) as mesh,
        bridging(router.endpoint, api, topic, tmp_path / "journal", limit=20, report=0.5) as bridge,
    ):
        await until_seen(mesh, bridge.address)
        for number in range(100):
            mesh.channel.publish(demand(cost=number))
        await until(lambda: bridge.status().to_ipfs.received == 100, seconds=60)
        await until(lambda: said() and "no-room" in said()[-1].getMessage(), seconds=60)
        status = bridge.status()
        assert (status.to_ipfs.kinds, status.to_ipfs.dropped) == ({"demand": 20}, {"no-room": 80})
        assert status.uptime > 0
    lines = said()
    assert 1 <= len(lines) < 10
    assert max(record.levelno for record in lines) == logging.WARNING
    assert lines[0].getMessage().startswith(f"{topic}: state=no daemon carries=False ")
