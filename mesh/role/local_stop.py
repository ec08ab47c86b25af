"""The owner's way to the robots of this machine, which needs no router: `aira stop`, `aira robot`.

Each agent that does jobs, and each edge agent, listens on a Unix socket in the folder `stop` of the data folder. Its
user, who alone may write there, may stop it, and change the settings of an agent. `Hold` is a file there: while it
exists, no job begins, also after a restart.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import msgspec

from mesh.base.log_context import log_event
from mesh.base.private_files import atomic_file, make_private_folder
from mesh.errors import AiraError
from schemas.decoding import InvalidData, decode_json
from schemas.records import ControlRobot, RobotControl  # msgspec reads the annotations

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from mesh.settings.groups import StorageSettings

log = logging.getLogger(__name__)

ANSWER_SECONDS: Final = 5.0
"""For which a stop waits for the answer of an agent or an edge agent."""
HELD: Final = "held"


class LocalRequest(msgspec.Struct, frozen=True):
    """A request to stop, and `why`, for people; or, to an agent, to do what its owner wants."""

    why: str = ""
    control: ControlRobot | None = None


class LocalAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """What an agent or a device did: it `heard` the request, or `detail` says why it could not do it."""

    who: str
    heard: bool
    detail: str = ""
    hint: str = ""
    code: str = ""
    control: RobotControl | None = None


def stop_folder(settings: StorageSettings) -> Path:
    """The folder of the sockets, and of what is held."""
    return settings.state_directory / "stop"


class Hold:
    """Whether an agent may begin jobs: not while its owner, or a stop of its own, holds it."""

    def __init__(self, folder: Path, address: str) -> None:
        self._all, self._own = folder / HELD, folder / f"{HELD}-{address}"

    @property
    def is_held(self) -> bool:
        """Whether no job may begin."""
        return self._all.exists() or self._own.exists()

    def hold(self, why: str) -> None:
        """Let this agent begin no job until `release`. Raises `OSError`."""
        _write_hold(self._own, why)

    def release(self) -> None:
        """Undo `hold`; if all agents of the folder are held, this one stays so. Raises `OSError`."""
        self._own.unlink(missing_ok=True)


def hold_all(folder: Path, why: str) -> None:
    """Let no agent of a data folder begin a job until `release`, also those that are not running. Raises `OSError`."""
    _write_hold(folder / HELD, why)


def release(folder: Path) -> int:
    """Let the agents of a data folder begin jobs again; returns how many holds there were. Raises `OSError`."""
    holds = list(folder.glob(f"{HELD}*"))
    for hold in holds:
        hold.unlink(missing_ok=True)
    return len(holds)


def _write_hold(path: Path, why: str) -> None:
    make_private_folder(path.parent)
    with atomic_file(path, private=True) as file:
        file.write(msgspec.json.encode({"why": why, "time": int(time.time())}))


@contextmanager
def listening(folder: Path, name: str, answer: Callable[[LocalRequest], LocalAnswer]) -> Iterator[None]:
    """Meanwhile answer the requests to this process's robot, on a thread of its own.

    Without a usable folder it only warns: the robot works, but can't be stopped like this.
    """
    path = folder / f"{name}.{os.getpid()}.sock"
    server = socket.socket(socket.AF_UNIX)
    try:
        make_private_folder(folder)
        with _short(path) as address:
            server.bind(address)
        server.listen(8)
    except OSError as error:
        facts = log_event("local-stop-unavailable", error=error.strerror)
        log.warning("`aira stop` can't reach %s here: %s", name, error.strerror, extra=facts)
        server.close()
        yield
        return

    def serve() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:  # it was shut down
                return
            with connection, contextlib.suppress(OSError, InvalidData):
                connection.settimeout(ANSWER_SECONDS)
                asked = decode_json(_read(connection), LocalRequest)
                connection.sendall(msgspec.json.encode(answer(asked)))

    thread = threading.Thread(target=serve, name="aira stop", daemon=True)
    thread.start()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        server.shutdown(socket.SHUT_RDWR)
        server.close()


def stop_here(folder: Path, why: str) -> list[LocalAnswer]:
    """Stop all that listen in a folder, at once; returns their answers. Blocks."""
    return _ask(folder.glob("*.sock"), LocalRequest(why))


def control_here(folder: Path, agent: str, asked: ControlRobot) -> RobotControl | None:
    """Let an agent (address) that listens in a folder do what its owner wants; None if it does not run there. Blocks.

    Raises what the agent answers, an `AiraError`.
    """
    answers = _ask(folder.glob(f"agent-{agent}.*.sock"), LocalRequest(control=asked))
    for answer in answers:
        if answer.control is None:
            raise AiraError(answer.detail, hint=answer.hint, code=answer.code)
    return answers[-1].control if answers else None


def agents_here(folder: Path) -> list[str]:
    """The agents (addresses) that listen in a folder, or were killed."""
    return sorted({path.name.split(".", 1)[0].removeprefix("agent-") for path in folder.glob("agent-*.sock")})


def _ask(sockets: Iterable[Path], asked: LocalRequest) -> list[LocalAnswer]:
    """The answers of all that listen, by name. Removes the sockets that nobody listens on."""
    answers: dict[str, LocalAnswer] = {}
    asking = [threading.Thread(target=_ask_one, args=(path, asked, answers), daemon=True) for path in sockets]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()
    return [answers[name] for name in sorted(answers)]


def _ask_one(path: Path, asked: LocalRequest, answers: dict[str, LocalAnswer]) -> None:
    name = path.name.split(".", 1)[0]
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(ANSWER_SECONDS)
        try:
            with _short(path) as address:
                client.connect(address)
            client.sendall(msgspec.json.encode(asked))
            client.shutdown(socket.SHUT_WR)
            answers[path.name] = decode_json(_read(client), LocalAnswer)
        except (ConnectionRefusedError, FileNotFoundError):  # its process was killed
            path.unlink(missing_ok=True)
        except (OSError, InvalidData):
            detail = f"no answer within {ANSWER_SECONDS:g} s"
            answers[path.name] = LocalAnswer(who=name.replace("-", " "), heard=False, detail=detail, code="busy")


def _read(connection: socket.socket) -> bytes:
    """What the other side sends until it sends no more."""
    data, longest = b"", 65_536
    while (part := connection.recv(longest)) and len(data) <= longest:
        data += part
    return data


@contextmanager
def _short(path: Path) -> Iterator[str]:
    """A text for the path of a socket: an address may have 107 bytes, and data folders may have longer names."""
    if len(os.fsencode(path)) <= 100:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)
