"""What `aira doctor` looks at on a serial line: the port, and the board at its other end."""

from __future__ import annotations

import grp
import os
import pwd
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Final

from bridges.serial.dialect import Ready
from bridges.serial.errors import LineError
from bridges.serial.line import Line
from bridges.serial.ports import Port, PortName
from bridges.serial.serving import dialect_of
from mesh.doctor.checks import Check, aside
from mesh.doctor.findings import Finding, broken, sound

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from mesh.doctor.case import Case
    from mesh.doctor.case import Line as LineOptions

ANSWER: Final = 5.0
"""Seconds in which a board answers; opening the port starts it anew, which takes most of two."""


def checks(case: Case) -> list[Check]:
    """The checks of a case's serial line."""
    port = Check("serial port", partial(aside, look_at_port, case.line))
    board = Check("serial board", partial(aside, listen_to_board, case.line), needs=((port,),))
    return [port, board]


def look_at_port(line: LineOptions) -> Finding:
    """Whether the port is there, may be used, and is used by nobody else. Raises `PortMissing`, `InputError`."""
    if not line.port:
        return broken("no serial port is named", do="give --port /dev/ttyACM0, or usb:VENDOR:PRODUCT")
    path = PortName(line.port).find()
    try:
        Port(path, baud=line.baud).close()
    except LineError as error:
        return _unusable(path, error)
    return sound(f"{path} opens at {line.baud:,} baud" + (f", found as {line.port}" if line.port != str(path) else ""))


def listen_to_board(line: LineOptions) -> Finding:
    """Whether a board answers in the protocol. Opening the port starts most boards anew."""
    dialect = dialect_of(line.protocol, baud=line.baud, parameters={})
    ready = threading.Event()
    there = Line(
        PortName(line.port),
        dialect,
        baud=line.baud,
        deliver=lambda happening: ready.set() if isinstance(happening, Ready) else None,
    )
    thread = threading.Thread(target=there.run, name="line of the doctor", daemon=True)
    began = time.monotonic()
    thread.start()
    answered = ready.wait(ANSWER)
    there.stop()
    thread.join(ANSWER)
    if answered and (about := dialect.about) is not None:
        name = " ".join(filter(None, (about.name, about.version))) or "a sketch"
        took = time.monotonic() - began
        return sound(f"{name} speaks {line.protocol}, {len(about.topics)} topics, after {took:.1f} s")
    other = "rosserial" if line.protocol == "frames" else "frames"
    return broken(
        f"no board answers in {line.protocol} at {line.baud:,} baud",
        do=f"is the firmware loaded, does --baud fit it, and does it speak {line.protocol}? else --protocol {other}",
    )


def _unusable(path: Path, error: LineError) -> Finding:
    """Why a port that is there can't be opened, and what helps."""
    why = str(error)
    if "permission" in why:
        return _forbidden(path)
    if "another process" in why:
        return broken(why, do=f"`fuser {path}` shows which; if it is `aira edge`, stop it to have the line tried")
    return broken(why, do="is this the board's port? `ls -l /dev/serial/by-id` shows what is plugged in")


def _forbidden(path: Path) -> Finding:
    """Ports belong to a group; on Debian to `dialout`."""
    about = path.stat()
    group, user = _name(grp.getgrgid, about.st_gid), _name(pwd.getpwuid, os.geteuid())
    found = f"{path} can't be opened by {user}: no permission; it belongs to the group {group}"
    if about.st_gid == 0:
        return broken(f"{found}, which nobody should be in", do="have udev give it to the group dialout, and join that")
    return broken(found, do=f"sudo usermod -aG {group} {user}, then log in anew (a service: restart it)")


def _name(find: Callable[[int], Sequence[object]], number: int) -> str:
    try:
        return str(find(number)[0])
    except KeyError:
        return str(number)
