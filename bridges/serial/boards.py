"""Simulated boards: firmware in a simulated Arduino Uno, with its serial line on a pseudo-terminal; also for tests of
robots that have one.

The simulator is a small C program of ours on libsimavr; it is compiled on first use and kept in the cache folder that
the programs of the tests share. A board uses about two thirds of a core. As on a real line, bytes are garbage if host
and firmware have different baud rates.
"""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import click

from bridges.serial.dialect import LineError
from bridges.serial.firmware import CORE, cache_folder, compile_sketch
from mesh.base.background import in_daemon_thread
from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError
from mesh.role.running import INTERRUPTED, fail

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

    from mesh import Agent


SOURCES: Final = Path(__file__).parent / "board"
HEADER: Final = Path("/usr/include/simavr/sim_avr.h")


@dataclass(frozen=True)
class PinChange:
    """A pin changed its level; `at` is in seconds of the board's own time."""

    pin: int
    high: bool
    at: float


@dataclass(frozen=True)
class Dimming:
    """A pin was dimmed by PWM: it is high for `value` of `top` counts; `at` is in seconds of the board's own time.

    A pin that is no longer dimmed has a `PinChange`.
    """

    pin: int
    value: int
    top: int
    at: float

    @property
    def duty(self) -> float:
        """The share of the time for which the pin is high, 0 to 1."""
        return self.value / self.top


def simulator(header: Path = HEADER) -> Path:
    """The simulator's program, compiled if necessary. Raises `ConfigurationError` where libsimavr or gcc is missing."""
    sources = sorted(SOURCES.glob("*.[ch]"))
    digest = hashlib.sha256(b"\0".join(source.read_bytes() for source in sources)).hexdigest()
    program = cache_folder() / f"board-{digest[:12]}"
    if program.exists():
        return program
    hint = "on Debian: apt-get install libsimavr-dev gcc; `make peers` does it"
    if not header.exists():
        raise ConfigurationError("libsimavr is not installed", hint=hint)
    program.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=program.parent) as folder:
        made = Path(folder) / "board"
        units = [str(source) for source in sources if source.suffix == ".c"]
        command = ["gcc", "-O2", *units, "-o", str(made), "-lsimavr", "-lutil"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            raise ConfigurationError("gcc is not installed", hint=hint) from None
        if done.returncode:
            raise ConfigurationError(f"the simulator does not compile:\n{done.stderr.strip()}", hint=hint)
        made.replace(program)
    return program


def check_firmware(path: Path) -> None:
    """Raise `InputError` for a file that is not an ELF file with code for an AVR."""
    head, why = b"", ""
    try:
        with path.open("rb") as file:
            head = file.read(20)
    except OSError as error:
        why = error.strerror or str(error)
    if not why and not head.startswith(b"\x7fELF"):
        why = "it is not an ELF file"
    if not why and int.from_bytes(head[18:20], "little") != 83:  # EM_AVR
        why = "it is for another processor"
    if why:
        hint = "`python -m bridges.serial.firmware SKETCH -o FOLDER` compiles a sketch to an ELF file"
        raise InputError(f"{path} is not firmware for an Uno: {why}", hint=hint, code="invalid-firmware")


def check_free(port: Path) -> None:
    """Raise `LineError` if this port exists, something else is there, or its folder is missing."""
    if port.is_char_device():
        hint = f"if no other board uses it: rm {port}"
        raise LineError(f"the port {port} exists already", hint=hint, code="port-busy")
    if port.exists() or not port.parent.is_dir():
        why = "it is a file" if port.exists() else "no folder"
        raise LineError(f"{port} can't become the port of the board: {why}", code="invalid-port")


class SimulatedBoard:
    """A board with the firmware `elf`: `with SimulatedBoard(elf) as board`, then open `board.port`.

    `port` is a path of one's own choice, or one in a new folder; it stays the same when the cable is pulled and plugged
    in again. With `resets`, opening the port resets the board, as it does a real Uno; with `monitor`, the output has
    what the board sends. `watch` is called with each line of the simulator's output. Entering raises `InputError`
    if the file is no firmware for an Uno, `LineError` if the path is in use, `ConfigurationError` if the simulator does
    not compile, and `RemoteError` (`board-failed`).
    """

    def __init__(
        self,
        elf: Path,
        *,
        resets: bool = False,
        port: Path | None = None,
        monitor: bool = False,
        watch: Callable[[str], object] | None = None,
    ) -> None:
        self._elf = elf
        self._chosen = port
        self._options = [*(["reset"] if resets else []), *(["monitor"] if monitor else [])]
        self._watch = watch
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.port = Path()
        """The path to open while the board runs; it does not exist while the cable is pulled."""
        self.pins: list[PinChange] = []
        """The changes of all pins so far, in order."""
        self.dimmings: list[Dimming] = []
        """The duties that PWM gave to pins so far, in order."""
        self.output: list[str] = []
        """The lines that the simulator has printed."""
        self._changed = threading.Condition()
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        check_firmware(self._elf)
        program = simulator()
        if self._chosen is None:
            self._folder = tempfile.TemporaryDirectory(prefix="aira-board-")
            self.port = Path(self._folder.name) / "tty"
        else:
            self.port = self._chosen.absolute()
            check_free(self.port)
        command = [str(program), str(self._elf), str(self.port), *self._options]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, bufsize=1
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), name="board", daemon=True)
        self._reader.start()
        try:
            self.wait_until(lambda: self._count("port ") > 0, what="the port")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            self._reader.join()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    stream.close()
        if self._folder is not None:
            self._folder.cleanup()

    def set_voltage(self, channel: int, millivolts: int) -> None:
        """Put a voltage, 0 to 5000 mV, on the analog input A0 to A7 of that number."""
        self.send(f"adc {channel} {millivolts}")

    def set_pin(self, pin: int, high: bool | None) -> None:
        """Hold the input with this number (14 to 19 are A0 to A5) at a level; None lets go of it."""
        self.send(f"pin {pin} {'free' if high is None else 'high' if high else 'low'}")

    def add_noise(self, rate: float, *, seed: int = 1) -> None:
        """From now on damage this share of the bytes on the line, in both directions."""
        self.send(f"noise {rate} {seed}")

    def reset(self) -> None:
        self.send("reset")

    def unplug(self) -> None:
        """Pull the cable; the board keeps running."""
        count = self._count("unplugged")
        self.send("unplug")
        self.wait_until(lambda: self._count("unplugged") > count, what="the unplugged")

    def plug(self) -> None:
        count = self._count("port ")
        self.send("plug")
        self.wait_until(lambda: self._count("port ") > count, what="the port")

    def changes(self, pin: int) -> list[PinChange]:
        return [change for change in self.pins if change.pin == pin]

    def wait_until(self, condition: Callable[[], object], *, what: str, seconds: float = 30.0) -> None:
        """Return when `condition()`, checked after each line of output, is true. Raises `RemoteError`."""
        deadline = time.monotonic() + seconds
        with self._changed:
            while not condition():
                left = deadline - time.monotonic()
                if left <= 0 or (self._process is not None and self._process.poll() is not None):
                    raise self._failed(f"gave up waiting for {what}; the board said")
                self._changed.wait(min(left, 0.2))

    def wait_for_end(self) -> None:
        self._running().wait()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            with self._changed:
                self.output.append(line.strip())
                match line.split():
                    case ["pin", pin, level, microseconds]:
                        self.pins.append(PinChange(int(pin), level == "1", int(microseconds) / 1e6))
                    case ["pwm", pin, value, top, microseconds]:
                        self.dimmings.append(Dimming(int(pin), int(value), int(top), int(microseconds) / 1e6))
                self._changed.notify_all()
            if self._watch is not None:
                self._watch(line.strip())

    def _count(self, word: str) -> int:
        return sum(line.startswith(word) for line in self.output)

    def send(self, line: str) -> None:
        """Send the simulator a command line: those of `aira board run`. Raises `RemoteError` when it has stopped."""
        process = self._running()
        assert process.stdin is not None
        try:
            process.stdin.write(f"{line.strip()}\n")
            process.stdin.flush()
        except BrokenPipeError:
            raise self._failed("the board has stopped; it said") from None

    def _failed(self, why: str) -> RemoteError:
        return RemoteError(f"{why}: {' | '.join(self.output[-10:])}", code="board-failed")

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            raise RemoteError("the board is not running", code="board-failed")
        return self._process


@asynccontextmanager
async def simulated_board(
    sketch: str | Path,
    agent: Agent,
    *,
    name: str = "board",
    protocol: str = "frames",
    baud: int = 57600,
    libraries: Sequence[Path] = (),
) -> AsyncIterator[SimulatedBoard]:
    """Compile a sketch for an Uno, simulate the board, and connect it to an agent at work as `aira edge` does.

    `sketch` is its folder. `name`, `protocol` and `baud` (bits per second) are those of
    `aira edge`, `libraries` Arduino libraries and folders of them. Yields the board: its pins change `pins` and
    `dimmings`; `set_pin`, `set_voltage`, `unplug` and `plug` change it. Compiling takes some seconds.

    Skips the test where the AVR tools are not installed. Raises `InputError` for a sketch that does not compile.
    """
    from bridges.serial._edge import Edge, EdgeOptions
    from mesh.network import Endpoints, Network

    if missing := _missing_tool():
        import pytest

        packages = "gcc-avr avr-libc arduino-core-avr libsimavr-dev gcc"
        pytest.skip(f"{missing} is not installed; on Debian: apt-get install {packages}")
    with tempfile.TemporaryDirectory(prefix="aira-sketch-") as made:
        elf = Path(made) / "board.elf"
        await asyncio.to_thread(compile_sketch, Path(sketch), elf, libraries=libraries)
        board = SimulatedBoard(elf)
        await asyncio.to_thread(board.__enter__)
        try:
            options = EdgeOptions(agent=agent.address, name=name, port=str(board.port), protocol=protocol, baud=baud)
            edge = Edge(options)
            async with Network(Endpoints(connect=agent.settings.connect)) as network:
                running = in_daemon_thread(lambda: edge.run(network.session), "edge of the board")
                try:
                    yield board
                finally:
                    edge.stop()
                    await asyncio.wrap_future(running)
        finally:
            await asyncio.to_thread(board.__exit__, None, None, None)


def _missing_tool() -> str:
    """A program that is needed and not installed; empty if all are."""
    if not CORE.is_dir():
        return "the Arduino core"
    return next((tool for tool in ("avr-gcc", "gcc") if shutil.which(tool) is None), "")


HELP = (
    "commands: pin 0-19 high|low|free, adc 0-7 MILLIVOLTS, send TEXT, monitor on|off, noise 0-1, unplug, plug, reset,"
    " quit"
)


@click.group("board", short_help="run firmware on a simulated board")
def command() -> None:
    """Run firmware on a simulated Arduino Uno."""


@command.command("run", short_help="run a firmware and show its pins")
@click.argument("firmware", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--tty",
    "port",
    metavar="PATH",
    type=click.Path(path_type=Path),
    help="path of the serial port, which exists as long as the board runs; by default a new one in a temporary folder",
)
@click.option("--reset-on-open", is_flag=True, help="opening the port resets the board, as on a real Uno")
@click.option(
    "--monitor", is_flag=True, help="show the text that the board sends, as the monitor of the Arduino IDE does"
)
def run(firmware: Path, port: Path | None, reset_on_open: bool, monitor: bool) -> None:
    """Run FIRMWARE (an ELF file), print its port, and show its pins as they change.

    Lines on stdin control the board: `pin 2 low` presses a button between pin 2 and ground, `pin 2 free` releases it,
    `adc 0 2500` puts 2.5 V on A0, `send hello` sends a line to the sketch, `unplug` and `plug` disconnect and connect
    the cable, `reset` restarts the board, `noise 0.01` corrupts 1 % of the bytes on the line. `quit` or Ctrl-C ends it.
    """
    try:
        with SimulatedBoard(firmware, port=port, resets=reset_on_open, monitor=monitor, watch=_show) as board:
            click.echo(f"{HELP}\nconnect it with: aira edge {board.port} --agent ADDRESS")
            for line in sys.stdin:
                if line.strip() == "quit":
                    return
                board.send(line)
            board.wait_for_end()
    except AiraError as error:
        fail(error)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _show(line: str) -> None:
    match line.split():
        case ["pin", pin, level, at]:
            click.echo(f"{_seconds(at)}  pin {pin:>2}  {'high' if level == '1' else 'low'}")
        case ["pwm", pin, value, top, at]:
            click.echo(f"{_seconds(at)}  pin {pin:>2}  {int(value) / int(top):.0%} ({value} of {top})")
        case ["serial", *_]:
            click.echo(line.removeprefix("serial "))
        case ["unknown", *words]:
            click.echo(f"{' '.join(words)!r} is not a command; {HELP}", err=True)
        case ["port" | "opened" | "closed" | "unplugged" | "crashed", *_]:
            click.echo(line)


def _seconds(microseconds: str) -> str:
    return f"{int(microseconds) / 1e6:10.3f} s"
