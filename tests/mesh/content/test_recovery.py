"""`kill -9` of a real process at every step of what it does to the store, and at any moment."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.content import Store
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream
from tests.support.content import ROOT, flip_bit, leftovers

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

QUOTA = 4_000_000

# Each step is a call of the operating system or of SQLite that the store's own code makes. The process forks once for
# every step, so that Python starts once: the fork does the work and kills itself before the step of its number.
STEPPER = """
import os, signal, sys
from mesh.content import Store

CALLS = {"execute", "executemany", "pwrite", "fsync", "rename", "ftruncate", "fchmod", "open", "unlink", "flock",
         "close", "mkdir", "replace", "listdir", "fetchone", "posix_fadvise"}

def kill_before(step):
    left = step
    def on_event(frame, event, function):
        nonlocal left
        if event == "c_call" and function.__name__ in CALLS:
            left -= 1
            if left < 0:
                os.kill(os.getpid(), signal.SIGKILL)
    return on_event

def work(directory):
    with Store(directory, quota=QUOTA) as store:
        WORK

directory = sys.argv[1]
for line in sys.stdin:
    step = int(line)
    child = os.fork()
    if not child:
        sys.setprofile(kill_before(step))
        work(directory)
        sys.setprofile(None)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    print("killed" if os.WIFSIGNALED(status) else "done" if not status else "failed", flush=True)
"""

PUTTER = """
import os, sys
from mesh.content import Store
number = int(sys.argv[2])
with Store(sys.argv[1], quota=QUOTA) as store:
    print("open", flush=True)
    for count in range(1000):
        data = f"{number} {count} ".encode() * (1 + (count * 7919) % 60_000)
        print(store.put_bytes(data, pin="job" if count % 5 == 0 else None), flush=True)
        if count % 5 == 4:
            store.release("job")
"""


def killed_at_each_step(directory: Path, work: str, *, check: Callable[[Path], None] | None = None) -> int:
    """Repeat the work, killed one step later each time, and check the store after each. Returns the number of steps."""
    check_store = check or check_consistent
    script = STEPPER.replace("QUOTA", str(QUOTA)).replace("WORK", work)
    with subprocess.Popen(
        [sys.executable, "-c", script, str(directory)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as stepper:
        assert stepper.stdin is not None
        assert stepper.stdout is not None
        for step in range(2000):
            print(step, file=stepper.stdin, flush=True)
            outcome = stepper.stdout.readline().strip()
            check_store(directory)
            if outcome == "done":
                stepper.stdin.close()
                return step
            assert outcome == "killed", f"{outcome!r} at step {step}"
    raise AssertionError("the work never ended")


def check_consistent(directory: Path) -> None:
    """Check a store after a crash: no leftovers, every file matches its CID, and the index has all blocks."""
    with Store(directory, quota=QUOTA) as store:
        held = store.list()
        assert store.check().damaged == ()
        assert store.damaged() == ()
        usage = store.usage()
        assert usage.files == len(held)
        assert usage.bytes == sum((directory / cid).stat().st_size for cid in held) <= QUOTA
        for cid in held:
            with (directory / cid).open("rb") as stream:
                for block in blocks_of_stream(stream):
                    assert store.get_block(block.cid) == block.data
    assert leftovers(directory) == []


def test_a_put_killed_at_any_step_leaves_a_consistent_store(tmp_path: Path) -> None:
    with Store(tmp_path, quota=QUOTA) as store:
        kept = store.put_bytes(b"was there before")
    work = f"store.put_bytes(bytes(range(256)) * {2 * CHUNK_SIZE // 256 + 1}, pin='job')"
    steps = killed_at_each_step(tmp_path, work)
    assert steps > 30
    with Store(tmp_path, quota=QUOTA) as store:
        assert kept in store.list()
        (put,) = (cid for cid in store.list() if cid != kept)
        assert store.pins() == {put: {"job"}}


@pytest.mark.full
def test_eviction_and_removal_killed_at_any_step_leave_a_consistent_store(tmp_path: Path) -> None:
    with Store(tmp_path, quota=QUOTA) as store:
        pinned = store.put_bytes(bytes(1_000_000), pin="job")
        for number in range(1, 4):
            store.put_bytes(bytes([number]) * 900_000)
    work = "store.put_bytes(b'x' * 2_500_000); [store.remove(cid) for cid in store.list() if cid not in store.pins()]"
    assert killed_at_each_step(tmp_path, work) > 30
    with Store(tmp_path, quota=QUOTA) as store:
        assert store.list() == (pinned,)


def test_setting_aside_killed_at_any_step_leaves_a_consistent_store(tmp_path: Path) -> None:
    damaged, sound = bytes(range(256)) * (2 * CHUNK_SIZE // 256 + 1), b"is as it was"

    def damage(directory: Path) -> None:
        with Store(directory, quota=QUOTA) as store:
            cid = store.put_bytes(damaged)
            assert store.damaged() == ()
        flip_bit(directory / cid, CHUNK_SIZE + 1)

    def check_set_aside(directory: Path) -> None:
        with Store(directory, quota=QUOTA) as store:
            held, aside = store.list(), store.damaged()
            (cid,) = {*held, *aside} - {kept}
            assert (cid in held) != (cid in aside), "it is held or set aside, never both"
            assert store.check().damaged == (() if aside else (cid,))
            assert store.list() == (kept,)
            assert store.damaged() == (cid,)
            assert store.usage().bytes == len(sound) + len(damaged)
            assert store.usage().files == 1
            assert store.get_block(kept) is not None
        damage(directory)

    with Store(tmp_path, quota=QUOTA) as store:
        kept = store.put_bytes(sound)
    damage(tmp_path)
    assert killed_at_each_step(tmp_path, "store.check()", check=check_set_aside) > 10


@pytest.mark.sample("seed")
@pytest.mark.parametrize("seed", range(3))
def test_acknowledged_puts_survive_kills_at_any_moment(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    script = PUTTER.replace("QUOTA", str(QUOTA))
    for number in range(10):
        with subprocess.Popen(
            [sys.executable, "-c", script, str(tmp_path), str(number)], cwd=ROOT, stdout=subprocess.PIPE, text=True
        ) as putter:
            assert putter.stdout is not None
            assert putter.stdout.readline() == "open\n"
            put = [putter.stdout.readline().strip() for _ in range(chance.randint(1, 12))]
            putter.send_signal(signal.SIGKILL)
            put += [cid for cid in putter.stdout.read().split() if len(cid) == len(put[0])]
        check_consistent(tmp_path)
        with Store(tmp_path, quota=QUOTA) as store:
            assert put[-1] in store.list(), "the last one put, at least, has not been deleted to make room"
            store.release("job")
