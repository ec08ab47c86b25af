"""The checks of a serial line for `aira doctor`: the port, and the board at its other end."""

from __future__ import annotations

import grp
import os
import pwd
import threading
import time
from functools import partial
from typing import TYPE_CHECKING

from bridges.serial.dialect import AUTO, BAUDS, BoardReady, LineError, make_dialect
from bridges.serial.line import PortName, SerialLine, SerialPort
from mesh.ops.doctor.checks import Check, CheckResult, failed, in_thread, passed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from mesh.ops.doctor.checks import DoctorContext, SerialSettings


def checks(context: DoctorContext) -> list[Check]:
    port = Check("serial port", partial(in_thread, check_port, context.serial))
    board = Check("serial board", partial(in_thread, check_board, context.serial), needs=((port,),))
    return [port, board]


def check_port(settings: SerialSettings) -> CheckResult:
    """Whether the port exists, may be used, and is not in use. Raises `LineError` if it is missing, `InputError`."""
    if not settings.port:
        return failed(
            "no serial port is given", code="no-port", hint="give --tty /dev/ttyACM0, or --tty usb:VENDOR:PRODUCT"
        )
    path = PortName(settings.port).find()
    try:
        SerialPort(path, baud=settings.baud or BAUDS[0]).close()
    except LineError as error:
        return _unusable(path, error)
    return passed(
        f"{path} opens"
        + (f" at {settings.baud:,} baud" if settings.baud else "")
        + (f", found as {settings.port}" if settings.port != str(path) else "")
    )


def check_board(settings: SerialSettings, *, timeout: float | None = None) -> CheckResult:
    """Whether a board answers in `timeout` seconds; as many as the search takes. Opening the port resets most."""
    dialect = make_dialect(settings.protocol, settings.baud)
    ready = threading.Event()
    line = SerialLine(
        PortName(settings.port), dialect, on_event=lambda event: ready.set() if isinstance(event, BoardReady) else None
    )
    thread = threading.Thread(target=line.run, name="line of the doctor", daemon=True)
    began = time.monotonic()
    thread.start()
    answered = ready.wait(dialect.silence if timeout is None else timeout)
    line.stop()
    thread.join()
    if answered and (info := dialect.info) is not None:
        name = " ".join(filter(None, (info.name, info.version))) or "a sketch"
        took = time.monotonic() - began
        speaks = f"{dialect.protocol} at {dialect.baud} baud"
        return passed(f"{name} answered in {speaks} after {took:.1f} s, with {len(info.topics)} topics")
    protocol = "a known protocol" if settings.protocol == AUTO else settings.protocol
    speed = f"{settings.baud:,} baud" if settings.baud else "a usual baud rate"
    return failed(
        f"no board answers in {protocol} at {speed}",
        code="board-silent",
        hint="check that the firmware is loaded; without --protocol and --baud both are searched for",
    )


def _unusable(path: Path, error: LineError) -> CheckResult:
    if error.code == "port-forbidden":
        return _forbidden(path)
    if error.code == "port-busy":
        return failed(
            str(error),
            code="port-busy",
            hint=f"`fuser {path}` shows the process; if it is `aira edge`, stop it to check the line",
        )
    return failed(
        str(error),
        code=error.code,
        hint="check that this is the board's port; `ls -l /dev/serial/by-id` lists connected devices",
    )


def _forbidden(path: Path) -> CheckResult:
    """Ports belong to a group; on Debian to `dialout`."""
    about = path.stat()
    group, user = _name(grp.getgrgid, about.st_gid), _name(pwd.getpwuid, os.geteuid())
    found = f"{path} can't be opened by {user}: no permission; it belongs to the group {group}"
    if about.st_gid == 0:
        return failed(
            f"{found}, which no user should join",
            code="port-forbidden",
            hint="let udev assign the port to the group dialout, and join that group",
        )
    return failed(
        found, code="port-forbidden", hint=f"sudo usermod -aG {group} {user}, then log in again (a service: restart it)"
    )


def _name(find: Callable[[int], Sequence[object]], number: int) -> str:
    try:
        return str(find(number)[0])
    except KeyError:
        return str(number)
