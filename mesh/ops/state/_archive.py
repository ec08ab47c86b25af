"""Which files of a data folder are the state of its agents, and the errors of the commands on it.

    0x…/1-5f3a…/ledger.sqlite               jobs, outbox and cursor of an account on one chain
    0x…/1-5f3a…/verdicts.sqlite             what a validator judged and signed, and its cursor
    0x…/1-5f3a…/provider-NAME.sqlite        withdrawals that the provider of the lighthouse NAME knows, and the
                                            orders of its transactions that may still be mined
    0x…/1-5f3a…/recordings/0x….mcap.part    recordings of running jobs
    0x…/content/Qm…                         files by their CID, and `.pins` beside them
    transactions/1-5f3a…/0x…/transactions.sqlite    pending transactions

Keyfiles and passwords are not part of it, and so never in a backup. Other files are never changed.

A backup is a tar (ustar, regular files only) in one zstd frame, which `tar --zstd` lists and unpacks. Its first member,
`state.json`, names the format; its last, `checksums.json`, has the SHA-256 of all others, so that a truncated file is
noticed. Headers are read in units of 512 bytes, so that a hostile file can't exhaust memory.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import tarfile
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, BinaryIO, Final, TypeVar

import msgspec
import zstandard

from mesh.base.private_files import sync_directory
from mesh.content.files import raising_store_full
from mesh.errors import ConfigurationError, InputError
from mesh.role.handover import HANDOVERS, RETIRED
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path


LEDGER: Final = "ledger.sqlite"
VERDICTS: Final = "verdicts.sqlite"
PROVIDER: Final = "provider-"
RECORDINGS: Final = "recordings"
CONTENT: Final = "content"
PINS: Final = ".pins"
TRANSACTIONS: Final = "transactions"
STAGES: Final = (".mcap.cut", ".mcap.part", ".mcap")
"""Suffixes of a recording while it is being resumed, written, and complete. A file changes its suffix in this order, so
a search in this order misses none."""

_ADDRESS: Final = r"0x[0-9a-fA-F]{40}"
_CHAIN: Final = r"[0-9]{1,20}-[0-9a-f]{8,64}"
_CID: Final = r"Qm[1-9A-HJ-NP-Za-km-z]{44}"
_ACCOUNT_FILE: Final = re.compile(
    rf"(?P<part>{_ADDRESS})/(?:{_CHAIN}/(?:(?:ledger|verdicts|{PROVIDER}[^/\0]+)\.sqlite"
    rf"|recordings/{_ADDRESS}\.mcap(?:\.part|\.cut)?)"
    rf"|content/(?:{_CID}|\.pins/{_CID}/[A-Za-z0-9_-]{{1,64}})|{re.escape(HANDOVERS)}|{re.escape(RETIRED)})"
)
_TRANSACTION: Final = re.compile(rf"(?P<part>transactions/{_CHAIN}/{_ADDRESS})/transactions\.sqlite")
_PART: Final = re.compile(rf"(?:transactions/{_CHAIN}/)?{_ADDRESS}")
_ADDRESS_NAME: Final = re.compile(_ADDRESS)
_CHAIN_NAME: Final = re.compile(_CHAIN)


def unusable(path: Path, why: str, *, hint: str = "use another backup; nothing was changed") -> InputError:
    """The error of a file that is not a backup, is damaged, or contains unexpected files. Nothing of it was used."""
    return InputError(f"{path} can't be used: {why}", hint=hint, code="archive-unusable")


def in_use(path: Path) -> ConfigurationError:
    """The error of state that a process is using, and that should be replaced."""
    return ConfigurationError(f"{path} is in use", hint="stop the process that uses it first", code="state-in-use")


def account_folders(folder: Path) -> tuple[Path, ...]:
    """The folders of the accounts that have files in a data folder."""
    return tuple(path for path in _folders(folder) if _ADDRESS_NAME.fullmatch(path.name))


def chains_in(home: Path) -> tuple[Path, ...]:
    """The folders of the chains on which an account has a database."""
    return tuple(path for path in _folders(home) if _CHAIN_NAME.fullmatch(path.name) and any(path.glob("*.sqlite")))


def provider_files_in(chain: Path) -> tuple[Path, ...]:
    """What an account's folder for a chain has of its providers."""
    return tuple(sorted(chain.glob(f"{PROVIDER}*.sqlite")))


def transactions_in(folder: Path) -> tuple[Path, ...]:
    """The tables of pending transactions in a data folder, of all accounts."""
    return tuple(
        path
        for path in sorted((folder / TRANSACTIONS).glob("*/*/transactions.sqlite"))
        if part_of(path.relative_to(folder).as_posix()) is not None
    )


def parts_in(folder: Path) -> tuple[str, ...]:
    """The parts that a data folder has; see `part_of`. Raises `ConfigurationError` if it has none."""
    sent = {path.parent.relative_to(folder).as_posix() for path in transactions_in(folder)}
    parts = (*sorted(sent), *(home.name for home in account_folders(folder)))
    if not parts:
        raise ConfigurationError(
            f"{folder} has no state of an agent", hint="give the data folder with --data-dir", code="state-missing"
        )
    return parts


def part_of(name: str) -> str | None:
    """The part of the state that a file belongs to, by its name in a backup: an account's folder, or the folder of its
    transactions on one chain. None if it is not a file of a state.

    A part is restored as a whole. No accepted name can escape the folder.
    """
    found = _ACCOUNT_FILE.fullmatch(name) or _TRANSACTION.fullmatch(name)
    return found["part"] if found else None


def pin_name(address: str, cid: str, label: str) -> str:
    """The name of a pin in a backup. (Its file name of 111 letters does not fit into a tar header.)"""
    return f"{address}/{CONTENT}/{PINS}/{cid}/{label}"


def path_of(name: str) -> str:
    """The path of a backup's file under the data folder."""
    folder, pin, label = name.rpartition("/")
    return f"{folder}.{label}" if pin and f"/{CONTENT}/{PINS}/" in folder else name


def _folders(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        yield from sorted(path for path in folder.iterdir() if path.is_dir() and not path.is_symlink())


T = TypeVar("T")

FORMAT: Final = 1
ABOUT: Final = "state.json"
CHECKSUMS: Final = "checksums.json"
LARGEST_TEXT: Final = 64 << 20
"""Most bytes of `state.json` and `checksums.json`: enough for a quarter of a million files."""
PIECE: Final = 1 << 20
"""Bytes read and written at once."""


class ArchiveInfo(msgspec.Struct, frozen=True, kw_only=True):
    """The description in a backup. `made` is its time (ISO 8601), `content` says which content files are included."""

    format: int
    made: str
    software: str
    content: str
    parts: tuple[str, ...]


@contextmanager
def new_archive(path: Path, about: ArchiveInfo) -> Iterator[ArchiveWriter]:
    """Write the backup at `path`, which appears when the block ends without an error, complete, or not at all.

    Only its owner can read it. Raises `StoreFull`, and `ConfigurationError` if it can't be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.unlink(missing_ok=True)  # in a shared folder such as /tmp it may belong to another user
        file = os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "wb")
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror}") from None
    try:
        archive = ArchiveWriter(file, path.parent, about)
        yield archive
        with raising_store_full(path.parent):
            archive.finish()
            temporary.rename(path)
            sync_directory(path.parent)
    finally:
        with suppress(OSError):  # what is still buffered then is deleted, and the first error is the one to raise
            file.close()
        temporary.unlink(missing_ok=True)


class ArchiveWriter:
    """Adds members to a backup in an open file."""

    def __init__(self, file: BinaryIO, folder: Path, about: ArchiveInfo) -> None:
        self._file = file
        self._folder = folder
        self.about: Final = about
        self._sums: dict[str, str] = {}
        self.size = 0
        """Bytes of the complete file; 0 before."""
        self._stream = zstandard.ZstdCompressor(write_checksum=True).stream_writer(file, closefd=False)
        self._add_text(ABOUT, msgspec.json.encode(about))

    def add(self, name: str, source: BinaryIO, *, size: int) -> None:
        """Add the next `size` bytes of `source`. Raises `ConfigurationError` if it has fewer, `StoreFull`."""
        with raising_store_full(self._folder):
            self._sums[name] = self._add(name, source, size)

    def finish(self) -> None:
        """Add the checksums, and sync the file."""
        sums = msgspec.json.encode(self._sums)
        if len(sums) > LARGEST_TEXT:
            raise ConfigurationError(
                f"{len(self._sums):,} files are more than a backup can list",
                hint="exclude content that agents can fetch again: --content needed, or none",
                code="too-many-files",
            )
        self._add_text(CHECKSUMS, sums)
        self._stream.write(bytes(2 * tarfile.BLOCKSIZE))
        self._stream.close()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self.size = self._file.tell()

    def _add_text(self, name: str, text: bytes) -> None:
        self._add(name, io.BytesIO(text), len(text))

    def _add(self, name: str, source: BinaryIO, size: int) -> str:
        """Add a member; returns its SHA-256."""
        header = tarfile.TarInfo(name)
        header.size, header.mode = size, 0o600
        try:
            self._stream.write(header.tobuf(tarfile.USTAR_FORMAT))
        except ValueError as error:  # 8 GiB or more, larger than any file of an agent
            raise ConfigurationError(f"{name} can't be backed up: {error}") from None
        digest, left = hashlib.sha256(), size
        while left:
            data = source.read(min(left, PIECE))
            if not data:
                raise ConfigurationError(f"{name} shrank while it was read", hint="try again")
            digest.update(data)
            self._stream.write(data)
            left -= len(data)
        self._stream.write(bytes(-size % tarfile.BLOCKSIZE))
        return digest.hexdigest()


def read_info(path: Path) -> ArchiveInfo:
    """Read the description of a backup and nothing else. Raises `InputError`."""
    with _opened(path) as reading:
        return reading.about()


def read_archive(path: Path, open_sink: Callable[[str, int], AbstractContextManager[BinaryIO]]) -> ArchiveInfo:
    """Write every file of a backup to the sink that `open_sink(name, size)` opens, and return the description.

    Names are files of a state, each once. Checksums are compared at the end. Raises `InputError`; what was written
    must not be used then.
    """
    with _opened(path) as reading:
        about, sums, listed = reading.about(), {}, 0
        while (header := reading.header()).name != CHECKSUMS:
            if part_of(header.name) not in about.parts or header.name in sums:
                raise unusable(path, f"it contains {header.name[:200]!r}, which is not part of a state")
            listed += len(header.name) + 64  # the digits of its SHA-256
            if listed > LARGEST_TEXT:
                raise unusable(path, "it contains more files than its checksums can list")
            with open_sink(header.name, header.size) as sink:
                sums[header.name] = reading.copy(header.size, sink)
        text = reading.text(header)
        reading.end()
        stated = reading.decoded(text, dict[str, str])
        if stated != sums:
            wrong = next(iter(sorted(name for name in {*sums, *stated} if sums.get(name) != stated.get(name))))
            raise unusable(path, f"the checksum of {wrong[:200]} does not match")
        return about


@contextmanager
def _opened(path: Path) -> Iterator[_ArchiveReader]:
    try:
        file = path.open("rb")
    except OSError as error:
        raise unusable(path, f"can't read it: {error.strerror}", hint="use another backup") from None
    with file:
        yield _ArchiveReader(path, file)


class _ArchiveReader:
    """Reads a backup's members in order."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path = path
        self._stream = zstandard.ZstdDecompressor().stream_reader(file)

    def about(self) -> ArchiveInfo:
        """The first member."""
        header = self.header()
        if header.name != ABOUT:
            raise unusable(self._path, "it is not a backup of a state", hint="`aira state backup` creates one")
        text = self.text(header)
        stated = self.decoded(text, dict[str, object]).get("format")
        if stated != FORMAT:
            why = f"it was written by another version (format {str(stated)[:20]}, this one knows {FORMAT})"
            raise unusable(self._path, why, hint="use the version of aira-mesh that wrote it, or a newer one")
        about = self.decoded(text, ArchiveInfo)
        if not all(_PART.fullmatch(part) for part in about.parts) or len(set(about.parts)) < len(about.parts):
            raise unusable(self._path, "it names parts that no state has")
        return about

    def header(self) -> tarfile.TarInfo:
        """The header of the next member, a regular file."""
        block = self._read(tarfile.BLOCKSIZE)
        try:
            header = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        except tarfile.HeaderError:
            raise unusable(self._path, "it is damaged or not a backup") from None
        if header.type != tarfile.REGTYPE or header.size < 0:
            raise unusable(self._path, f"{header.name[:200]!r} in it is not a regular file")
        return header

    def text(self, header: tarfile.TarInfo) -> bytes:
        """All bytes of a member."""
        if header.size > LARGEST_TEXT:
            raise unusable(self._path, f"{header.name} in it is too long")
        text = self._read(header.size)
        self._read(-header.size % tarfile.BLOCKSIZE)
        return text

    def decoded(self, text: bytes, kind: type[T]) -> T:
        """Decode a member's JSON."""
        try:
            return decode_json(text, kind)
        except InvalidData as error:
            raise unusable(self._path, f"it is damaged: {error}") from None

    def copy(self, size: int, sink: BinaryIO) -> str:
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
            raise unusable(self._path, f"it is damaged ({error})") from None
        if any(rest) or len(rest) > 2 * tarfile.BLOCKSIZE:
            raise unusable(self._path, "it has data after its end")

    def _read(self, size: int) -> bytes:
        """Exactly `size` bytes."""
        pieces, left = [], size
        while left:
            try:
                piece = self._stream.read(left)
            except (zstandard.ZstdError, OSError) as error:
                raise unusable(self._path, f"it is damaged or not a backup ({error})") from None
            if not piece:
                raise unusable(self._path, "it is truncated")
            pieces.append(piece)
            left -= len(piece)
        return b"".join(pieces)
