"""`aira board`: simulated boards."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mesh.errors import AiraError
from mesh.running import INTERRUPTED, fail

HELP = "commands: adc 0-7 MILLIVOLTS, noise 0-1, unplug, plug, reset, quit"


@click.group("board", short_help="run firmware on a simulated board")
def command() -> None:
    """Run firmware on a simulated Arduino Uno."""


@command.command("run", short_help="run a firmware and show its pins")
@click.argument("firmware", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--reset-on-open", is_flag=True, help="opening the port resets the board, as on a real Uno")
def run(firmware: Path, reset_on_open: bool) -> None:
    """Run FIRMWARE (an ELF file), print its port, and show its pins as they change.

    Lines on stdin control the board: `adc 0 2500` puts 2.5 V on A0, `unplug` and `plug` disconnect and connect the
    cable, `reset` presses the button, `noise 0.01` corrupts 1 % of the bytes on the line. `quit` or Ctrl-C stops it.
    """
    from bridges.serial.boards import SimulatedBoard

    try:
        with SimulatedBoard(firmware, resets=reset_on_open, watch=_show) as board:
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
        case ["pin", pin, level, microseconds]:
            click.echo(f"{int(microseconds) / 1e6:10.3f} s  pin {pin:>2}  {'high' if level == '1' else 'low'}")
        case ["unknown", *words]:
            click.echo(f"{' '.join(words)!r} is not a command; {HELP}", err=True)
        case ["port" | "opened" | "closed" | "unplugged" | "crashed", *_]:
            click.echo(line)
