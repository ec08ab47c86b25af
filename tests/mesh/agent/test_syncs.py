"""What a robot syncs in a job: files and folders."""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING

from mesh import Agent
from mesh.testing import assert_paid
from tests.support.agent.restarts import SAYING, speaking
from tests.support.market import MODEL, offering

if TYPE_CHECKING:
    import pytest

    from mesh.testing import Market


async def test_a_job_syncs_recording_and_result_and_no_more(market: Market, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the objective, which can be fetched again, nor what only repeats what is on the disk."""
    synced, fsync = Counter[str](), os.fsync
    async with market.robot(speaking(offering(Agent(MODEL)), [])) as robot:

        def count(descriptor: int) -> None:
            path = os.readlink(f"/proc/self/fd/{descriptor}")
            if path.startswith(robot.settings.data_dir):
                synced[re.sub("0x[0-9a-fA-F]{40}|[0-9a-f]{16}|[0-9]+-[0-9a-f]{8}", "…", path.rpartition("/")[2])] += 1
            fsync(descriptor)

        monkeypatch.setattr(os, "fsync", count)
        assert_paid(await market.order(MODEL, SAYING))
    recording = synced.pop("….mcap.part")
    assert recording >= 1, "once more for each second that a busy machine takes"
    assert synced == {"ledger.sqlite-wal": 3, "recordings": 1, ".put-…": 1, "content": 1, ".pins": 1}
