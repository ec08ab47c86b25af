"""`aira board`: simulated boards."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mesh.errors import AiraError
from mesh.running import INTERRUPTED, fail

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
    "--port",
    type=click.Path(path_type=Path),
    help="path of the port, which exists as long as the board runs; by default a new one in a temporary folder",
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
    from bridges.serial.boards import SimulatedBoard

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
