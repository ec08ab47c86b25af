"""The file of a backup: a tar (ustar, regular files only) in one zstd frame, which `tar --zstd` lists and unpacks.

Its first member, `state.json`, names the format; its last, `checksums.json`, has the SHA-256 of all others, so that a
truncated file is noticed. Headers are read in units of 512 bytes, so that a hostile file can't exhaust memory.
"""

from __future__ import annotations

import hashlib
import os
import tarfile
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol, Self, TypeVar

import msgspec
import zstandard

from mesh.content.files import raising_store_full, sync_directory
from mesh.errors import ConfigurationError
from mesh.state.layout import ArchiveUnusable, TooManyFiles, is_part, part_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager
    from pathlib import Path
    from types import TracebackType

T = TypeVar("T")

FORMAT: Final = 1
ABOUT: Final = "state.json"
CHECKSUMS: Final = "checksums.json"
LARGEST_TEXT: Final = 64 << 20
"""Most bytes of `state.json` and `checksums.json`: enough for a quarter of a million files."""
DIGITS: Final = 64
"""Digits of a SHA-256 in `checksums.json`."""
PIECE: Final = 1 << 20
"""Bytes read and written at once."""


class ArchiveInfo(msgspec.Struct, frozen=True, kw_only=True):
    """The description in a backup. `made` is its time (ISO 8601), `content` says which content files are included."""

    format: int
    made: str
    software: str
    content: str
    parts: tuple[str, ...]


class Sink(Protocol):
    """Takes the bytes of one member."""

    def write(self, data: bytes, /) -> object: ...


class ArchiveWriter:
    """Writes the backup at `path`: `with ArchiveWriter(path, about) as archive`, then `add`.

    Only its owner can read it. It appears when the block ends without an error, complete, or not at all. Raises
    `StoreFull`, and `ConfigurationError` if it can't be written.
    """

    def __init__(self, path: Path, about: ArchiveInfo) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}")
        self.about: Final = about
        self._sums: dict[str, str] = {}
        self.size = 0
        """Bytes of the complete file; 0 before."""

    def __enter__(self) -> Self:
        try:
            with suppress(FileNotFoundError):
                self._temporary.unlink()  # in a shared folder such as /tmp it may belong to another user
            descriptor = os.open(self._temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise ConfigurationError(f"can't write {self._path}: {error.strerror}") from None
        self._file = os.fdopen(descriptor, "wb")
        self._stream = zstandard.ZstdCompressor(write_checksum=True).stream_writer(self._file, closefd=False)
        self._add_text(ABOUT, msgspec.json.encode(self.about))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                with raising_store_full(self._path.parent):
                    self._finish()
        finally:
            with suppress(OSError):  # what is still buffered then is deleted, and the first error is the one to raise
                self._file.close()
            with suppress(FileNotFoundError):
                self._temporary.unlink()

    def add(self, name: str, source: BinaryIO, *, size: int) -> None:
        """Add the next `size` bytes of `source`. Raises `ConfigurationError` if it has fewer."""
        digest, left = hashlib.sha256(), size
        with raising_store_full(self._path.parent):
            self._begin(name, size)
            while left:
                data = source.read(min(left, PIECE))
                if not data:
                    raise ConfigurationError(f"{name} shrank while it was read", hint="try again")
                digest.update(data)
                self._stream.write(data)
                left -= len(data)
            self._pad(size)
        self._sums[name] = digest.hexdigest()

    def _finish(self) -> None:
        sums = msgspec.json.encode(self._sums)
        if len(sums) > LARGEST_TEXT:
            raise TooManyFiles(len(self._sums))
        self._add_text(CHECKSUMS, sums)
        self._stream.write(bytes(2 * tarfile.BLOCKSIZE))
        self._stream.close()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self.size = self._file.tell()
        self._temporary.rename(self._path)
        sync_directory(self._path.parent)

    def _add_text(self, name: str, text: bytes) -> None:
        self._begin(name, len(text))
        self._stream.write(text)
        self._pad(len(text))

    def _begin(self, name: str, size: int) -> None:
        header = tarfile.TarInfo(name)
        header.size, header.mode = size, 0o600
        try:
            self._stream.write(header.tobuf(tarfile.USTAR_FORMAT))
        except ValueError as error:  # 8 GiB or more, larger than any file of an agent
            raise ConfigurationError(f"{name} can't be backed up: {error}") from None

    def _pad(self, size: int) -> None:
        self._stream.write(bytes(-size % tarfile.BLOCKSIZE))


def read_info(path: Path) -> ArchiveInfo:
    """Read the description of a backup and nothing else. Raises `ArchiveUnusable`."""
    with _ArchiveReader(path) as reading:
        return reading.about()


def read_archive(path: Path, open_sink: Callable[[str, int], AbstractContextManager[Sink]]) -> ArchiveInfo:
    """Write every file of a backup to the sink that `open_sink(name, size)` opens, and return the description.

    Names are files of a state, each once. Checksums are compared at the end. Raises `ArchiveUnusable`; what was written
    must not be used then.
    """
    with _ArchiveReader(path) as reading:
        about, sums, listed = reading.about(), {}, 0
        while (header := reading.header()).name != CHECKSUMS:
            if part_of(header.name) not in about.parts or header.name in sums:
                raise ArchiveUnusable(
                    path, "unexpected-file", f"it contains {header.name[:200]!r}, which is not part of a state"
                )
            listed += len(header.name) + DIGITS
            if listed > LARGEST_TEXT:
                raise ArchiveUnusable(path, "too-many-files", "it contains more files than its checksums can list")
            with open_sink(header.name, header.size) as sink:
                sums[header.name] = reading.copy(header.size, sink)
        text = reading.text(header)
        reading.end()
        stated = reading.decoded(text, dict[str, str])
        if stated != sums:
            wrong = next(iter(sorted(name for name in {*sums, *stated} if sums.get(name) != stated.get(name))))
            raise ArchiveUnusable(path, "wrong-checksum", f"the checksum of {wrong[:200]} does not match")
        return about


class _ArchiveReader:
    """Reads a backup's members in order."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        try:
            self._file = self._path.open("rb")
        except OSError as error:
            raise ArchiveUnusable(
                self._path, "unreadable", f"can't read it: {error.strerror}", hint="use another backup"
            ) from None
        self._stream = zstandard.ZstdDecompressor().stream_reader(self._file)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._file.close()

    def about(self) -> ArchiveInfo:
        """The first member."""
        header = self.header()
        if header.name != ABOUT:
            raise ArchiveUnusable(
                self._path, "not-a-backup", "it is not a backup of a state", hint="`aira state backup` creates one"
            )
        text = self.text(header)
        stated = self.decoded(text, dict[str, object]).get("format")
        if stated != FORMAT:
            why = f"it was written by another version (format {str(stated)[:20]}, this one knows {FORMAT})"
            raise ArchiveUnusable(
                self._path, "other-version", why, hint="use the version of aira-mesh that wrote it, or a newer one"
            )
        about = self.decoded(text, ArchiveInfo)
        if not all(is_part(part) for part in about.parts) or len(set(about.parts)) < len(about.parts):
            raise ArchiveUnusable(self._path, "unexpected-part", "it names parts that no state has")
        return about

    def header(self) -> tarfile.TarInfo:
        """The header of the next member, a regular file."""
        block = self._read(tarfile.BLOCKSIZE)
        try:
            header = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        except tarfile.HeaderError:
            raise ArchiveUnusable(self._path, "not-a-backup", "it is damaged or not a backup") from None
        if header.type != tarfile.REGTYPE or header.size < 0:
            raise ArchiveUnusable(self._path, "not-a-file", f"{header.name[:200]!r} in it is not a regular file")
        return header

    def text(self, header: tarfile.TarInfo) -> bytes:
        """All bytes of a member."""
        if header.size > LARGEST_TEXT:
            raise ArchiveUnusable(self._path, "too-long", f"{header.name} in it is too long")
        text = self._read(header.size)
        self._read(-header.size % tarfile.BLOCKSIZE)
        return text

    def decoded(self, text: bytes, kind: type[T]) -> T:
        """Decode a member's JSON."""
        try:
            return msgspec.json.decode(text, type=kind)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise ArchiveUnusable(self._path, "damaged", f"it is damaged: {error}") from None

    def copy(self, size: int, sink: Sink) -> str:
        """Write the bytes of a member to `sink`; returns their SHA-256."""
        digest, left = hashlib.sha256(), size
        while left:
            data = self._read(min(left, PIECE))
            digest.update(data)
            sink.write(data)
            left -= len(data)
        self._read(-size % tarfile.BLOCKSIZE)
        return digest.hexdigest()

    def end(self) -> None:
        """Check that nothing follows. This also compares the checksum of the zstd frame."""
        try:
            rest = self._read(2 * tarfile.BLOCKSIZE) + self._stream.read(1)
        except zstandard.ZstdError as error:
            raise ArchiveUnusable(self._path, "damaged", f"it is damaged ({error})") from None
        if any(rest) or len(rest) > 2 * tarfile.BLOCKSIZE:
            raise ArchiveUnusable(self._path, "trailing-data", "it has data after its end")

    def _read(self, size: int) -> bytes:
        """Exactly `size` bytes."""
        pieces, left = [], size
        while left:
            try:
                piece = self._stream.read(left)
            except (zstandard.ZstdError, OSError) as error:
                raise ArchiveUnusable(self._path, "damaged", f"it is damaged or not a backup ({error})") from None
            if not piece:
                raise ArchiveUnusable(self._path, "truncated", "it is truncated")
            pieces.append(piece)
            left -= len(piece)
        return b"".join(pieces)
