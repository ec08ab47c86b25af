"""State on the disk is readable by its own user only, whatever the umask: files 600, folders 700.

State that an older version or another program left more open is tightened when it is opened. A process that locks a
file holds the lock until it closes the file, or ends, by whatever. Locks are those of `flock`, which Windows does not
have: `fcntl` is imported where a file is locked.
"""

from __future__ import annotations

import errno
import os
import stat
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, BinaryIO, Final, TypeAlias

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mesh.errors import AiraError

PRIVATE_FILE: Final = 0o600
PRIVATE_FOLDER: Final = 0o700
_OTHERS: Final = 0o077
SHORTEST_TOKEN: Final = 16
LARGEST_SECRET: Final = 16_384
"""Bytes of a secret in a file."""
_DATABASE_SUFFIXES: Final = ("", "-wal", "-shm")
Locked: TypeAlias = int | BinaryIO
"""An open file, or its descriptor."""


def make_private_folder(folder: Path) -> None:
    """Create a folder for state, and parents that are missing, for this user only. Raises `OSError`.

    An existing folder that is more open is tightened with all that is in it; its parents stay as they are.
    """
    make_missing_folders(folder)
    if tighten(folder):
        for path in folder.rglob("*"):
            with suppress(FileNotFoundError):  # temporary files go away
                tighten(path)


def make_missing_folders(folder: Path) -> None:
    """Create the folder and its parents for this user only where they are missing. Raises `OSError`."""
    for missing in reversed([folder, *folder.parents]):
        if not missing.exists():
            missing.mkdir(mode=PRIVATE_FOLDER, exist_ok=True)
    if not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))


def open_private(path: Path | str, flags: int) -> int:
    """Open a file as `os.open` does, creating it for this user only (an `opener` for `open`). Raises `OSError`."""
    descriptor = os.open(path, flags | os.O_CLOEXEC, PRIVATE_FILE)
    status = os.fstat(descriptor)
    if status.st_mode & _OTHERS and status.st_uid == os.geteuid() and stat.S_ISREG(status.st_mode):
        os.fchmod(descriptor, stat.S_IMODE(status.st_mode) & ~_OTHERS)
    return descriptor


def lock(file: Locked) -> None:
    """Lock a file for this opening of it alone; waits while another one has it."""
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX)


def lock_shared(file: Locked) -> None:
    """Lock a file together with others that share it; waits while one has it alone. Gives up a lock for it alone."""
    import fcntl

    fcntl.flock(file, fcntl.LOCK_SH)


def try_lock(file: Locked) -> bool:
    """Lock a file for this opening of it alone, unless another one has it; whether that succeeded."""
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_locked(path: Path, *, ours_is_shared: bool = False) -> bool:
    """Whether this process or another has the file at `path` locked, so that it could not be locked as well."""
    import fcntl

    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if ours_is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


@contextmanager
def held_alone(path: Path, otherwise: AiraError) -> Iterator[None]:
    """Hold a private file, made if missing, alone of all processes. Raises `otherwise` if another has it."""
    descriptor = open_private(path, os.O_RDWR | os.O_CREAT)
    try:
        if not try_lock(descriptor):
            raise otherwise
        yield
    finally:
        os.close(descriptor)


def make_private_database(path: Path) -> None:
    """Create the empty file of an SQLite database, or tighten an existing one with its log. Raises `OSError`.

    SQLite gives the files beside it the mode of the database.
    """
    os.close(open_private(path, os.O_RDWR | os.O_CREAT))
    for suffix in _DATABASE_SUFFIXES[1:]:
        beside = path.with_name(path.name + suffix)
        if beside.exists():
            tighten(beside)


def tighten(path: Path) -> bool:
    """Take all rights of others from this user's file or folder; whether there were any.

    Folders that users share, as /tmp, and links stay as they are.
    """
    status = path.lstat()
    is_ours = status.st_uid == os.geteuid() and not status.st_mode & stat.S_ISVTX and not stat.S_ISLNK(status.st_mode)
    if not (status.st_mode & _OTHERS and is_ours):
        return False
    path.chmod(stat.S_IMODE(status.st_mode) & ~_OTHERS)
    return True


def write_new(path: Path | str, content: bytes, *, mode: int = PRIVATE_FILE) -> None:
    """Write and sync a file that does not exist yet. Raises `OSError`, `FileExistsError` among them."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def kept_secret(path: Path, make: Callable[[], bytes], *, what: str, code: str) -> bytes:
    """The content of a file that only this user can read, which is made if it is missing: the token or key of a server.

    Raises `ConfigurationError` with this `code`; `what` names the file for people.
    """
    try:
        path.parent.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
        if not path.exists():
            write_new(path, make())
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            content = file.read(LARGEST_SECRET)
    except OSError as error:
        raise ConfigurationError(f"can't use the {what} {path}: {error.strerror or error}", code=code) from None
    if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & _OTHERS:
        raise ConfigurationError(f"others can read the {what} {path}", hint=f"chmod 600 {path}", code=code)
    return content


def private_token(path: Path) -> str:
    """The token in a file that only this user can read, which is made if it is missing. Raises `ConfigurationError`."""
    import secrets  # loads OpenSSL, which edge agents do without

    make = lambda: secrets.token_urlsafe(32).encode() + b"\n"  # noqa: E731
    content = kept_secret(path, make, what="token file", code="token-file-unusable")
    try:
        token = content.decode("ascii").strip()
    except UnicodeError:
        raise ConfigurationError(
            f"can't use the token file {path}: not a text in ASCII", code="token-file-unusable"
        ) from None
    if len(token) < SHORTEST_TOKEN:
        raise ConfigurationError(
            f"the token in {path} is too short",
            hint=f"use at least {SHORTEST_TOKEN} characters, or remove the file: a new one is made",
            code="token-too-short",
        )
    return token


@contextmanager
def atomic_file(final: Path, *, private: bool = False) -> Iterator[BinaryIO]:
    """A stream to a file that appears at `final`, complete and synced, if the `with` block ends without error.

    Only this user can read it if it is `private`.
    """
    temporary = final.with_name(f"{final.name}.new")
    try:
        with open(temporary, "wb", opener=open_private if private else None) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.rename(final)
        sync_directory(final.parent)
    finally:
        temporary.unlink(missing_ok=True)


def sync_directory(directory: Path) -> None:
    """Sync the names of the directory to the disk: a rename is durable only after this."""
    _sync(directory, os.O_DIRECTORY)


def sync_file(path: Path) -> None:
    """Sync what was written to a file, by whomever."""
    _sync(path, 0)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
