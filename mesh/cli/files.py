"""Files that commands write and tell of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from mesh.errors import AiraError, ConfigurationError, InputError
from mesh.running import fail

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

T = TypeVar("T")

_UNITS: Final = ("bytes", "KiB", "MiB", "GiB", "TiB")


def at_once(work: Callable[[], T]) -> T:
    """Do what needs no event loop, so that Ctrl-C ends it at any moment. Errors are told as by `run_to_end`."""
    try:
        return work()
    except AiraError as error:
        fail(error)


def free(path: Path) -> Path:
    """The same path, if nothing is there and its folder is. Raises `InputError`: no file is written over."""
    if path.exists():
        raise InputError(f"{path} is there already", hint="choose another name, or move it away")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent}", hint="make it first")
    return path


def unwritable(path: Path, error: OSError) -> ConfigurationError:
    """What to raise when the disk refuses a file."""
    return ConfigurationError(f"can't write {path}: {error.strerror}")


def size_words(size: int) -> str:
    """A number of bytes as people read it."""
    scaled, unit = float(size), 0
    while scaled >= 1024 and unit < len(_UNITS) - 1:
        scaled, unit = scaled / 1024, unit + 1
    return f"{size:,} bytes" if not unit else f"{scaled:.1f} {_UNITS[unit]}"


def duration_words(nanoseconds: int) -> str:
    """A length of time as people read it."""
    seconds = nanoseconds / 1e9
    if seconds < 120:
        return f"{seconds:.3f}".rstrip("0").rstrip(".") + " s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
