"""A market of real processes, for cells of the crash matrix one after another."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.chain import NewLiability
from mesh.chain.following import list_created
from schemas import ZERO_ADDRESS
from tests.crashes.points import GO, REACHED
from tests.crashes.process import CONTROL, COST, OBJECTIVE, POINT, VALIDATOR, WORDS
from tests.support.cli.site import GENERATION_5, Site
from tests.support.commands import Serving, invoke
from tests.support.content import ROOT
from tests.support.nodes import Anvil
from tests.support.objectives import objective
from tests.support.processes import ServerFailed
from tests.support.routers import Zenohd
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Self

    from schemas import Liability
    from tests.crashes.matrix import Cell

REACH_SECONDS: Final = 180.0
END_SECONDS: Final = 180.0
STOPPED_SECONDS: Final = 3.0
CLOCK_JUMP: Final = -3_600.0
REORGANISED: Final = 3
"""Blocks that a reorganisation drops with their transactions."""
DISK_BYTES: Final = 16 << 20
READY: Final = {
    "provider": "provider-started",
    "robot": "agent-started",
    "validator": "validator-started",
    "person": "person-started",
}
"""What each role logs when it has started, in the order in which they start."""
STEP_NS: Final = 10**8


class CrashMarket:
    """`with CrashMarket() as market: market.play(cell)`. Roles that no cell touched go on running for the next.

    In generation 5, a jury whose juror is the validator judges all jobs.
    """

    def __init__(self, generation: int = 3) -> None:
        self._options = dict(GENERATION_5) if generation == 5 else {}
        self._stack = ExitStack()
        self._running: dict[str, Serving] = {}
        self._played = 0
        self._ended_logs: list[tuple[str, str]] = []
        """Of processes that ended by themselves in this cell."""

    def __enter__(self) -> Self:
        self.folder = Path(tempfile.mkdtemp(prefix="aira-crashes-"))
        self._stack.callback(shutil.rmtree, self.folder, ignore_errors=True)
        self.node = self._stack.enter_context(Anvil(arguments=("--block-time", "0.5", "--mixed-mining")))
        self.router = self._stack.enter_context(Zenohd())
        self._stack.callback(self._stop_all)
        self._runner = self._stack.enter_context(asyncio.Runner())
        found = Site.found(self.node.url, self.node.private_keys, self.router.endpoint, self.folder)
        self.site = self._runner.run(found)
        chain = AsyncExitStack()
        self._chain = self._runner.run(chain.enter_async_context(self.site.chain("provider")))
        self._stack.callback(lambda: self._runner.run(chain.aclose()))
        self._judge = self.site.address("validator")
        if self._options:
            self._judge = self._runner.run(self._chain.validators.deploy([self._judge], 1)).address
            self._options["validator_contract"] = self._judge
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stack.close()

    def play(self, cell: Cell) -> None:
        """One job with the fault, to its end: the contract is paid once or refunded, and the recording complete."""
        try:
            self._play(cell)
        except AssertionError:
            self.__exit__()  # what failed must not fail the next cells: they get a new market
            self.__enter__()
            raise

    def _play(self, cell: Cell) -> None:
        self._played += 1
        control = self.folder / f"control-{self._played}"
        control.mkdir()
        work = self.folder / f"{self._played}.mcap"
        work.write_bytes(objective(*(("/say", f"{word} {self._played}") for word in WORDS), step_ns=STEP_NS))
        before = self._runner.run(self._balances())
        self._ended_logs.clear()
        with self._disk(cell) as disk:
            try:
                self._start_for(cell, control, work, disk)
                wait_until((control / REACHED).exists, what=f"{cell.point}", seconds=REACH_SECONDS)
                self._fail(cell, control, disk)
                liability = self._ended(cell, work)
                self._check(cell, work, liability, before)
            except (AssertionError, ServerFailed) as error:
                running = {role: one.log() for role, one in self._running.items()}
                logs = "\n".join(f"--- {role}\n{log[-3_000:]}" for role, log in [*self._ended_logs, *running.items()])
                self._stop_all()
                raise AssertionError(f"{cell.name}: {error}\n{logs}") from None
            finally:
                self._stop("person")
                if cell.fault in ("disk", "clock"):  # the next cell's job is for a process without the fault
                    self._stop(cell.victim)

    def _start_for(self, cell: Cell, control: Path, work: Path, disk: Path | None) -> None:
        """Start the process that reaches the point, and those that are not running; the person at last."""
        self._stop(cell.at)
        for role in _roles_of(cell):
            if role not in self._running:
                armed = {POINT: str(cell.point), CONTROL: str(control)} if role == cell.at else {}
                self._start(role, work, disk if role == cell.victim else None, **self._validator(cell), **armed)

    def _validator(self, cell: Cell) -> dict[str, str]:
        """The validator of a cell's job, as a variable of the person."""
        return {VALIDATOR: self._judge} if "validator" in _roles_of(cell) else {}

    def _start(self, role: str, work: Path, disk: Path | None, **armed: str) -> None:
        # The jobs of a whole matrix are more than a provider gives away in a day.
        options = {"log_format": "json", "playback": "recorded", "free_contracts": "100000", **self._options}
        options["data_dir"] = str(disk or self.folder / f"state-{role}")
        variables = self.site.variables(role, **options) | {OBJECTIVE: str(work), "PYTHONPATH": str(ROOT)} | armed
        command = (sys.executable, "-m", "tests.crashes.process", role)
        process = Serving(*command, says=READY[role], variables=variables)
        process.start_seconds = END_SECONDS
        self._running[role] = process
        process.start()

    def _fail(self, cell: Cell, control: Path, disk: Path | None) -> None:
        """Apply the fault, and let the process that waits at the point go on."""
        go = control / GO
        match cell.fault:
            case "kill" if cell.victim in READY:
                self._stop(cell.victim, how="kill")
            case "kill":
                self.router.kill()
                go.touch()
                time.sleep(STOPPED_SECONDS)
                self.router.start()
            case "stop":
                victim: Any = {"router": self.router, "node": self.node}.get(cell.victim) or self._running[cell.victim]
                victim.pause()
                go.touch()
                time.sleep(STOPPED_SECONDS)
                victim.resume()
            case "clock":
                go.write_text(str(CLOCK_JUMP))
            case "reorganise":
                self._runner.run(self._reorganise())
            case "disk":
                assert disk is not None
                filler = disk / "filler"
                _fill(filler)
                go.touch()
                time.sleep(STOPPED_SECONDS)
                filler.unlink()
        go.touch()

    def _ended(self, cell: Cell, work: Path) -> Liability:
        """The finalized liability of the job. Processes that end on the way are started again, as systemd would."""
        from schemas import cid_of_file

        cid, deadline = cid_of_file(work), time.monotonic() + END_SECONDS
        while True:
            self._revive(work, cell)
            liabilities = self._runner.run(self._liabilities(cid))
            if len(liabilities) == 1 and liabilities[0].is_finalized:
                # Read again: while anvil mines, it may show a part of the next block in the state of the last one.
                (liability,) = self._runner.run(self._liabilities(cid))
                return liability
            assert len(liabilities) < 2, f"the order was made into {len(liabilities)} contracts"
            assert time.monotonic() < deadline, f"the job did not end: {liabilities}"
            time.sleep(0.2)

    def _revive(self, work: Path, cell: Cell) -> None:
        disk = self.folder / "disk" if cell.fault == "disk" else None
        for role in _roles_of(cell):
            process = self._running.get(role)
            is_over = process is not None and role == "person" and "person-done" in process.log()
            if process is None or not (is_over or process.is_running):
                if process is not None:
                    self._ended_logs.append((f"{role}, which ended", process.log()))
                self._stop(role)
                self._start(role, work, disk if role == cell.victim else None, **self._validator(cell))

    def _check(self, cell: Cell, work: Path, liability: Liability, before: dict[str, int]) -> None:
        """Paid once or refunded, and `aira verify` holds. Only a full disk may end a job without success."""
        assert liability.is_success or cell.fault == "disk", "the job failed"
        assert liability.validator == self._validator(cell).get(VALIDATOR, ZERO_ADDRESS)
        paid = COST if liability.is_success else 0
        expected = {"person": before["person"] - paid, "robot": before["robot"] + paid}
        wait_until(lambda: self._runner.run(self._balances()) == expected, what=f"one payment of {paid}")
        variables = self.site.variables("person", data_dir=str(self.folder / "verify"), **self._options)
        if liability.is_success:
            self._revive(work, cell)  # the robot has the files, and may have ended since
            verified = invoke("verify", liability.address, **variables)
            assert verified.returncode == 0, (verified.stdout, verified.stderr)

    async def _balances(self) -> dict[str, int]:
        return {role: await self._chain.tokens.balance(self.site.address(role)) for role in ("person", "robot")}

    async def _liabilities(self, cid: str) -> list[Liability]:
        found = await self._chain.liabilities.list(promisee=self.site.address("person"))
        return [liability for liability in found if liability.objective == cid]

    async def _reorganise(self) -> None:
        """Drop the last blocks.

        What anvil mines at the same moment may leave a gap in its chain, or be left without its state: drop that, too.
        """
        node, depth = self._chain.node, REORGANISED
        while True:
            await node.request("anvil_reorg", depth, [])
            head = await node.block_number()
            recent = range(head - 4 * REORGANISED, head)
            gaps = [number for number in recent if not await node.request("eth_getBlockByNumber", hex(number), False)]
            if gaps:
                print(f"anvil lost the blocks {gaps}", file=sys.stderr)
                depth = head + 2 - gaps[0]
                continue
            events = await list_created(node, self._chain.factory, head - 2 * REORGANISED)
            made = [event.liability for event in events if isinstance(event, NewLiability)]
            if all([await node.code(liability) for liability in made]):
                return
            print("anvil keeps logs without their state", file=sys.stderr)
            depth = REORGANISED

    @contextmanager
    def _disk(self, cell: Cell) -> Iterator[Path | None]:
        """A small disk for the state of the role, if the cell fills it."""
        if cell.fault != "disk":
            yield None
            return
        disk = self.folder / "disk"
        disk.mkdir(exist_ok=True)
        self._stop(cell.victim)
        mount: list[str | Path] = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "none", disk]
        if subprocess.run(mount, capture_output=True).returncode:
            pytest.skip("a disk of its own needs root and the right to mount")
        try:
            yield disk
        finally:
            subprocess.run(["umount", "--lazy", disk], check=True)

    def _stop(self, role: str, *, how: str = "stop") -> None:
        process = self._running.pop(role, None)
        if process is not None:
            getattr(process, how)()
            process.close()

    def _stop_all(self) -> None:
        for role in list(self._running):
            self._stop(role, how="kill")


def _roles_of(cell: Cell) -> list[str]:
    """The processes that a cell needs, in the order in which they start."""
    return [role for role in READY if role != "validator" or role == cell.victim or cell.generation == 5]


def _fill(filler: Path) -> None:
    """Fill the disk to its last byte."""
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            with suppress(OSError):
                while file.write(b"\0" * size):
                    pass
