"""Errors of serial lines and of calls to devices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError

if TYPE_CHECKING:
    from collections.abc import Sequence


class LineError(RemoteError):
    """A serial port can't be opened, read or written."""

    code = "line-error"


class PortMissing(LineError):
    """The port does not exist now; the board may be plugged in later."""

    code = "port-missing"

    def __init__(self, port: str, why: str) -> None:
        super().__init__(f"no serial port {port}: {why}", hint="is the board plugged in?")
        self.port = port


class PortForbidden(LineError):
    """This user has no permission to open the port."""

    code = "port-forbidden"


class PortBusy(LineError):
    """Another process uses the port."""

    code = "port-busy"


class InvalidPort(LineError):
    """The path is not a serial port."""

    code = "invalid-port"


class UnknownDialect(InputError):
    """No installed package provides a dialect of that name."""

    code = "unknown-dialect"

    def __init__(self, name: str, known: Sequence[str]) -> None:
        super().__init__(
            f"there is no dialect {name!r}; installed: {', '.join(known) or 'none'}",
            hint="choose an installed one, or (re)install the package that provides it",
        )
        self.name = name
        self.known = tuple(known)


class BrokenDialect(ConfigurationError):
    """A dialect that an installed package registers can't be imported."""

    code = "dialect-broken"

    def __init__(self, name: str, package: str, error: Exception) -> None:
        super().__init__(
            f"can't load the dialect {name!r} of {package}: {type(error).__name__}: {error}",
            hint=f"reinstall or uninstall {package}",
        )
        self.name = name
        self.package = package


class InvalidBoardMessage(InputError):
    """A message can't be sent to the board: wrong type, unknown topic, or too long for its buffer or the line."""

    code = "invalid-board-message"

    def __init__(self, topic: str, why: str) -> None:
        super().__init__(f"a message for {topic} can't be sent: {why}")
        self.topic = topic


class BoardBusy(RemoteError):
    """The queue of commands for the board is full."""

    code = "board-busy"

    def __init__(self, topic: str, waiting: int) -> None:
        super().__init__(f"a message for {topic} was not sent: {waiting} commands are already waiting for the board")
        self.topic = topic
        self.waiting = waiting


class CallFailed(AiraError):
    """A call to a device failed; `reason` is a short word for programs, a key of `CALL_ERRORS`."""

    code = "call-failed"

    def __init__(self, topic: str, reason: str, detail: str) -> None:
        super().__init__(f"{topic}: {detail} ({reason})")
        self.topic = topic
        self.reason = reason
        self.detail = detail


class CallRefused(CallFailed):
    """The device or its edge agent refused the call, and would refuse it again."""

    code = "call-refused"


class CallNotDone(CallFailed):
    """The device certainly did not do it: it was absent, or busy with earlier calls. It is safe to try again."""

    code = "call-not-done"


class CallInDoubt(CallFailed):
    """It is not known whether the device did it: it was restarted or unplugged before it answered."""

    code = "call-in-doubt"


CALL_ERRORS: Final[dict[str, type[CallFailed]]] = {
    "refused": CallRefused,
    "unfit": CallRefused,
    "absent": CallNotDone,
    "expired": CallNotDone,
    "full": CallNotDone,
    "doubt": CallInDoubt,
}
"""The reasons for which a call fails, as they travel, and the error of each."""
