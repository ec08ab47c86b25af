"""What is kept of the keys that an owner has replaced: the handovers of the new key, and the mark of the old one.

Both are files in the accounts' folders of the data folder, so that they go into its backups.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from mesh.base.private_files import atomic_file, make_private_folder
from mesh.content.store import is_in_use
from mesh.errors import ConfigurationError
from schemas.decoding import InvalidData, decode_json
from schemas.profiles import PROFILE_LIMITS, Handover

if TYPE_CHECKING:
    from pathlib import Path

T = TypeVar("T")

HANDOVERS: Final = "handovers.json"
RETIRED: Final = "retired.json"


def rotation_file(keyfile: Path) -> Path:
    """The file beside a keyfile that says, until the end, how far the rotation of its key is."""
    return keyfile.with_name(f"{keyfile.name}.rotation")


def handovers_to(state: Path, address: str) -> tuple[Handover, ...]:
    """The handovers that brought a robot to this address, oldest first. Raises `ConfigurationError`."""
    return _read(state / address / HANDOVERS, tuple[Handover, ...]) or ()


def check_not_retired(state: Path, address: str) -> None:
    """Raise `ConfigurationError` (`key-retired`) if the owner has replaced the key of this address."""
    if (handover := _read(state / address / RETIRED, Handover)) is not None:
        raise ConfigurationError(
            f"the key of {address} is retired: its work goes on as {handover.successor}",
            hint="name the new keyfile in the settings",
            code="key-retired",
        )


def keep_handover(state: Path, handover: Handover) -> None:
    """Let a new key prove whose work it goes on with. Raises `ConfigurationError`, `OSError`."""
    before = tuple(one for one in handovers_to(state, handover.agent) if one.agent != handover.successor)
    _write(state / handover.successor / HANDOVERS, (*before, handover)[-PROFILE_LIMITS.handovers :])


def retire(state: Path, handover: Handover) -> None:
    """Let no role use the old key of a handover any more. Raises `OSError`."""
    _write(state / handover.agent / RETIRED, handover)


def adopt_content(state: Path, address: str) -> None:
    """Take over the content of the key before: recordings and files that others may still fetch.

    Raises `ConfigurationError` (`predecessor-running`) while that one's robot runs, `OSError`.
    """
    content = state / address / "content"
    if content.exists() or not (handovers := handovers_to(state, address)):
        return
    before = state / handovers[-1].agent / "content"
    if not before.exists():
        return
    if is_in_use(before):
        raise ConfigurationError(
            f"the robot still runs under its old key, {handovers[-1].agent}", hint="stop it", code="predecessor-running"
        )
    before.rename(content)


def _read(path: Path, kind: type[T]) -> T | None:
    try:
        return decode_json(path.read_bytes(), kind)
    except FileNotFoundError:
        return None
    except (OSError, InvalidData) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"can't use {path}: {why}", code="handover-unusable") from None


def _write(path: Path, content: object) -> None:
    make_private_folder(path.parent)
    with atomic_file(path, private=True) as file:
        file.write(msgspec.json.encode(content))
