"""What a robot syncs in a job: files and folders."""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING

from tests.mesh.agent.restarts import COST, SAYING, speaking

if TYPE_CHECKING:
    import pytest

    from tests.support.market import Place


async def test_a_job_syncs_its_recording_and_result_and_no_more(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the objective, which can be fetched again, nor what only repeats what is on the disk."""
    synced: Counter[str] = Counter()
    fsync = os.fsync

    def count(descriptor: int) -> None:
        path = os.readlink(f"/proc/self/fd/{descriptor}")
        if path.startswith(str(place.folder / "robot")):
            synced[re.sub("0x[0-9a-fA-F]{40}|[0-9a-f]{16}|[0-9]+-[0-9a-f]{8}", "…", path.rpartition("/")[2])] += 1
        fsync(descriptor)

    robot = speaking(place.agent("robot", playback="at-once"), [])
    robot.on_demand(robot.offer)
    async with place.provider(), place.agent("person") as person, robot:
        monkeypatch.setattr(os, "fsync", count)
        contract = await person.demand(SAYING, cost=COST)
        assert (await contract.outcome()).success

    recording = synced.pop("….mcap.part")
    assert recording >= 1, "once more for each second that a busy machine takes"
    assert synced == {"ledger.sqlite-wal": 3, "recordings": 1, ".put-…": 1, "content": 1, ".pins": 1}
