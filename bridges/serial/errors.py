"""What can go wrong between the mesh and a device."""

from __future__ import annotations

from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError


class LineError(RemoteError):
    """The serial line, or what is at its other end, does not do what it should."""

    code = "line-error"


class PortMissing(LineError):
    """There is no such port now; it may be plugged in later."""

    code = "port-missing"

    def __init__(self, port: str, why: str) -> None:
        super().__init__(f"no serial port {port}: {why}", hint="is the board plugged in?")
        self.port = port


class UnfitMessage(InputError):
    """A message can't be sent to the board: the wrong type, too long for its buffer or for its line."""

    code = "unfit-message"

    def __init__(self, topic: str, why: str) -> None:
        super().__init__(f"a message for {topic} can't be sent: {why}")
        self.topic = topic


class BoardBusy(RemoteError):
    """More commands wait for the board than are kept."""

    code = "board-busy"

    def __init__(self, topic: str, waiting: int) -> None:
        super().__init__(f"a message for {topic} is not sent: {waiting} commands wait for the board already")
        self.topic = topic
        self.waiting = waiting


class CallFailed(AiraError):
    """A call of a device did not end well; `reason` is a short machine-readable word, one of `REASONS`."""

    code = "call-failed"

    def __init__(self, topic: str, reason: str, detail: str) -> None:
        super().__init__(f"{topic}: {detail} ({reason})")
        self.topic = topic
        self.reason = reason
        self.detail = detail


class CallRefused(CallFailed):
    """The device, or the edge agent before it, has not done it, and would not do it the next time either."""

    code = "call-refused"


class CallNotDone(CallFailed):
    """The device has certainly not done it: it was not there, or other calls were before it. Trying again is safe."""

    code = "call-not-done"


class CallInDoubt(CallFailed):
    """Nobody knows whether the device has done it: it was restarted or unplugged before it said so."""

    code = "call-in-doubt"


REASONS: dict[str, type[CallFailed]] = {
    "refused": CallRefused,
    "unfit": CallRefused,
    "absent": CallNotDone,
    "expired": CallNotDone,
    "full": CallNotDone,
    "doubt": CallInDoubt,
}
"""The machine-readable reasons for which a call ends without having been done, and the error that each is."""

__all__ = [
    "REASONS",
    "BoardBusy",
    "CallFailed",
    "CallInDoubt",
    "CallNotDone",
    "CallRefused",
    "ConfigurationError",
    "LineError",
    "PortMissing",
    "UnfitMessage",
]
