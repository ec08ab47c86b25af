"""A finished job under the control of a viewer: play, pause, speed, seek."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from foxglove.websocket import PlaybackCommand, PlaybackStatus
from hypothesis import given, settings
from hypothesis import strategies as st

from bridges.foxglove.server import FoxgloveServer
from bridges.foxglove.sources import PLAYER_PACE, PlaybackHead, RecordingPlayer
from mesh.base.background import Background
from mesh.recording import GENEROUS, open_objective
from tests.support.foxglove.viewer import PAUSE, PLAY, Viewer, viewing
from tests.support.objectives import timed
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

SECOND = 10**9
START = 1000 * SECOND


@asynccontextmanager
async def playing(front: Any, folder: Path, *messages: tuple[str, object, float]) -> AsyncIterator[Viewer]:
    """A viewer of a recording with these messages: topic, value, seconds."""
    path = folder / "recording.mcap"
    path.write_bytes(timed((topic, value, START + round(at * SECOND)) for topic, value, at in messages))
    player = RecordingPlayer(open_objective(path, GENEROUS))
    async with (
        front() as view,
        FoxgloveServer(view, "a recording", control=player.control) as server,
        Background() as tasks,
    ):
        tasks.start(player.run(server), "playback")
        async with viewing(view.url) as viewer:
            await until(lambda: len(viewer.topics) == len({topic for topic, _, _ in messages}))
            yield viewer


def seconds(viewer: Viewer, topic: str = "/x") -> list[float]:
    """The times of what was seen on a topic, in seconds from the start."""
    return [(seen.log_time - START) / SECOND for seen in viewer.seen if seen.topic == topic]


async def until_ended(viewer: Viewer, count: int) -> None:
    """Return when the playback has ended and so many messages have come: what ends it may overtake them."""
    await until(lambda: viewer.states[-1].status == "ended" and len(seconds(viewer)) >= count, what=f"{count} messages")


STEPS = tuple(("/x", float(number), number / 10) for number in range(101))


async def test_a_recording_is_played_to_its_end_and_again(front: Any, tmp_path: Path) -> None:
    async with playing(front, tmp_path, *STEPS) as viewer:
        assert viewer.info["dataStartTime"]["sec"] == 1000
        assert viewer.info["dataEndTime"]["sec"] == 1010
        started = await viewer.control(PLAY, request="one", speed=50)
        assert (started.status, started.speed) == ("playing", 50)
        await until_ended(viewer, 101)
        assert seconds(viewer) == [number / 10 for number in range(101)]
        assert viewer.states[-1].at_ns == START + 10 * SECOND
        assert viewer.times == sorted(viewer.times)
        viewer.seen.clear()
        again = await viewer.control(PLAY, request="two", speed=50)
        assert (again.status, again.did_seek, again.at_ns) == ("playing", True, START)
        await until(lambda: len(viewer.seen) == 101)


async def test_nothing_moves_while_it_is_paused(front: Any, tmp_path: Path) -> None:
    async with playing(front, tmp_path, *STEPS) as viewer:
        await asyncio.sleep(0.2)
        assert viewer.seen == []
        await viewer.control(PLAY, request="play", speed=5)
        await viewer.until_seen("/x", 5)
        paused = await viewer.control(PAUSE, request="pause", speed=5)
        seen = -1
        while seen != len(viewer.seen):  # what was under way arrives
            seen = len(viewer.seen)
            await asyncio.sleep(0.3)
        assert seconds(viewer)[-1] <= (paused.at_ns - START) / SECOND
        await viewer.control(PLAY, request="on", speed=50)
        await until_ended(viewer, 101)
        assert seconds(viewer) == [number / 10 for number in range(101)]


async def test_a_jump_shows_the_last_message_of_each_topic_before(front: Any, tmp_path: Path) -> None:
    steps = (("/state", "begun", 0.05), *STEPS)
    async with playing(front, tmp_path, *steps) as viewer:
        for request, at in (("to the end", 9.95), ("back", 4.55)):
            viewer.seen.clear()
            state = await viewer.control(PAUSE, request=request, seek=START + round(at * SECOND))
            assert (state.status, state.did_seek, state.at_ns) == ("paused", True, START + round(at * SECOND))
            await until(lambda: len(viewer.seen) == 2)
            assert seconds(viewer, "/state") == [0.05]
            assert seconds(viewer) == [int(at * 10) / 10]
        host, port = viewer.socket.remote_address
        async with viewing(f"ws://{host}:{port}") as later:
            await until(lambda: len(later.seen) == 2)
            assert (seconds(later, "/state"), seconds(later)) == ([0.05], [4.5])
        viewer.seen.clear()
        await viewer.control(PLAY, request="on", speed=100)
        await until_ended(viewer, 2)
        assert seconds(viewer)[:2] == [4.6, 4.7]


async def test_the_speed_is_kept(front: Any, tmp_path: Path) -> None:
    async with playing(front, tmp_path, *STEPS) as viewer:
        slow = await viewer.control(PLAY, request="slow", speed=0)
        assert abs(slow.speed - PLAYER_PACE.slowest) < 1e-6
        await viewer.control(PLAY, request="fast", speed=1e9)
        assert viewer.states[-1].speed == PLAYER_PACE.fastest


async def test_a_recording_of_one_message(front: Any, tmp_path: Path) -> None:
    async with playing(front, tmp_path, ("/x", 1.0, 0.0)) as viewer:
        await viewer.control(PLAY, request="play")
        await until_ended(viewer, 1)
        assert seconds(viewer) == [0.0]


requests = st.builds(
    lambda command, speed, seek: SimpleNamespace(
        playback_command=command, playback_speed=speed, seek_time=seek, request_id="one"
    ),
    st.sampled_from([PlaybackCommand.Play, PlaybackCommand.Pause]),
    st.floats(width=32),
    st.none() | st.integers(0, 2**64 - 1),
)


@settings(deadline=None)
@given(st.lists(st.tuples(requests, st.integers(0, 100 * SECOND)), max_size=20))
def test_whatever_is_requested_the_playback_stays_in_the_recording(steps: list[tuple[Any, int]]) -> None:
    now = 0
    head = PlaybackHead(START, START + 10 * SECOND, clock=lambda: now)
    for request, passed in steps:
        before, was = head.now_ns, head.status
        state = head.handle(request)
        assert PLAYER_PACE.slowest <= head.speed <= PLAYER_PACE.fastest
        assert START <= state.current_time <= head.end_ns
        if request.seek_time is None and was != PlaybackStatus.Ended:
            assert state.current_time == before
            assert not state.did_seek
        now += passed
        assert state.current_time <= head.now_ns <= head.end_ns
        if head.now_ns == head.end_ns and (ended := head.end(head.seeks)) is not None:
            assert ended.status == PlaybackStatus.Ended
        assert head.end(head.seeks - 1) is None
