"""Errors of serial lines and of calls to devices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError

if TYPE_CHECKING:
    from collections.abc import Sequence


class LineError(RemoteError, code="line-error"):
    """A serial port can't be opened, read or written."""


class PortMissing(LineError, code="port-missing"):
    """The port does not exist now; the board may be plugged in later."""

    def __init__(self, port: str, why: str) -> None:
        super().__init__(f"no serial port {port}: {why}", hint="is the board plugged in?")
        self.port = port


class PortForbidden(LineError, code="port-forbidden"):
    """This user has no permission to open the port."""


class PortBusy(LineError, code="port-busy"):
    """Another process uses the port."""


class InvalidPort(LineError, code="invalid-port"):
    """The path is not a serial port."""


class UnknownDialect(InputError, code="unknown-dialect"):
    """No installed package provides a dialect of that name."""

    def __init__(self, name: str, known: Sequence[str]) -> None:
        super().__init__(
            f"there is no dialect {name!r}; installed: {', '.join(known) or 'none'}",
            hint="choose an installed one, or (re)install the package that provides it",
        )
        self.name = name
        self.known = tuple(known)


class BrokenDialect(ConfigurationError, code="dialect-broken"):
    """A dialect that an installed package registers can't be imported."""

    def __init__(self, name: str, package: str, error: Exception) -> None:
        super().__init__(
            f"can't load the dialect {name!r} of {package}: {type(error).__name__}: {error}",
            hint=f"reinstall or uninstall {package}",
        )
        self.name = name
        self.package = package


class InvalidBoardMessage(InputError, code="invalid-board-message"):
    """A message can't be sent to the board: wrong type, unknown topic, or too long for its buffer or the line."""

    def __init__(self, topic: str, why: str) -> None:
        super().__init__(f"a message for {topic} can't be sent: {why}")
        self.topic = topic


class BoardBusy(RemoteError, code="board-busy"):
    """The queue of commands for the board is full."""

    def __init__(self, topic: str, waiting: int) -> None:
        super().__init__(f"a message for {topic} was not sent: {waiting} commands are already waiting for the board")
        self.topic = topic
        self.waiting = waiting


class DeviceSilent(RemoteError, code="device-silent"):
    """A device published nothing on a topic."""

    def __init__(self, device: str, topic: str, seconds: float) -> None:
        super().__init__(
            f"the device {device} published nothing on {topic} within {seconds:g} s",
            hint="is it plugged in, and its `aira edge` running?",
        )
        self.device = device
        self.topic = topic


class CallFailed(AiraError, code="call-failed"):
    """A call to a device failed; `reason` is a short word for programs: a key of `CALL_ERRORS`, or `no-such-topic`."""

    def __init__(self, topic: str, reason: str, detail: str) -> None:
        super().__init__(f"{topic}: {detail}" + (f" ({reason})" if reason != self.code else ""))
        self.topic = topic
        self.reason = reason
        self.detail = detail


class CallRefused(CallFailed, code="call-refused"):
    """The device or its edge agent refused the call, and would refuse it again."""


class NoSuchTopic(CallRefused, code="no-such-topic"):
    """The device has no topic of that name to call; `topics` are those that it has."""

    def __init__(self, device: str, topic: str, topics: Sequence[str]) -> None:
        super().__init__(topic, "no-such-topic", f"no such topic to call; {device} has {', '.join(topics) or 'none'}")
        self.device = device
        self.topics = tuple(topics)


class CallNotDone(CallFailed, code="call-not-done"):
    """The device certainly did not do it: it was absent, or busy with earlier calls. It is safe to try again."""


class CallInDoubt(CallFailed, code="call-in-doubt"):
    """It is not known whether the device did it: it was restarted or unplugged before it answered."""


CALL_ERRORS: Final[dict[str, type[CallFailed]]] = {
    "refused": CallRefused,
    "unfit": CallRefused,
    "absent": CallNotDone,
    "expired": CallNotDone,
    "full": CallNotDone,
    "doubt": CallInDoubt,
}
"""The reasons for which a call fails, as they travel, and the error of each."""
