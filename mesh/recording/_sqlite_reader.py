"""Reading databases of rosbag2 (`.db3`) of unknown origin.

SQLite executes what a schema contains: views, generated columns, functions in them. So the tables are checked before
they are read, nothing else of the schema may be used, and no value may be longer than a record. The index is not used,
since it may contain anything. The file is never written.

A database beside which a crash left changes that it lacks is refused. SQLite would merge them when it opens the
database for writing; here they are only looked for, page by page. Source: the file format of SQLite, sections 3 (the
rollback journal) and 4 (the write-ahead log).
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from functools import partial
from struct import Struct, unpack
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from mesh.recording._source import (
    RUN,
    CorruptRecording,
    ExpansionCounter,
    NotARecording,
    RecordedMessage,
    RecordingBlock,
    RecordingChannel,
    RecordingSource,
    Segment,
    check_window,
    survey_block,
    text_of,
)
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording._source import BlockReader, Limits, OnMessage


_JOURNAL_MAGIC: Final = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
_LOG_MAGIC: Final = 0x377F0682
"""Of a log whose checksums are little-endian; the last bit is set if they are big-endian."""
_LOG_HEADER: Final = Struct(">8I")
_FRAME_HEADER: Final = Struct(">6I")
_PAGE_SIZES: Final = frozenset(1 << power for power in range(9, 17))


def _check_journals(database: Path) -> None:
    """Raise `NotARecording` if a journal of SQLite beside the file holds changes that it lacks, or can't be read.

    A journal that is empty, was reset, holds no complete transaction or was merged already holds none.
    """
    rollback = database.with_name(f"{database.name}-journal")
    log = database.with_name(f"{database.name}-wal")
    journal = ""
    try:
        if rollback.exists():
            with rollback.open("rb") as file:
                if file.read(len(_JOURNAL_MAGIC)) == _JOURNAL_MAGIC:
                    journal = rollback.name
        if not journal and log.exists():
            with log.open("rb") as changes, database.open("rb") as pages:
                if _has_changes(changes, pages):
                    journal = log.name
    except OSError as error:
        raise NotARecording(f"a journal of SQLite beside it can't be read: {error}") from None
    if journal:
        do = f'sqlite3 {database.name} "PRAGMA wal_checkpoint(TRUNCATE); SELECT count(*) FROM messages"'
        why = f"messages may be missing, since {journal} beside it holds changes; with copies of both: {do}"
        raise NotARecording(why)


def _has_changes(log: BinaryIO, database: BinaryIO) -> bool:
    """Whether a write-ahead log holds committed pages that differ from those of the database."""
    header = log.read(_LOG_HEADER.size)
    if len(header) < _LOG_HEADER.size:
        return False
    magic, _version, size, _sequence, *salts_and_sums = _LOG_HEADER.unpack(header)
    order = ">" if magic & 1 else "<"
    sums = _checksum(header[:24], order, (0, 0))
    if magic & ~1 != _LOG_MAGIC or size not in _PAGE_SIZES or list(sums) != salts_and_sums[2:]:
        return False
    committed: dict[int, int] = {}
    """Where the last committed content of each page is in the log."""
    written: dict[int, int] = {}
    while len(frame := log.read(_FRAME_HEADER.size + size)) == _FRAME_HEADER.size + size:
        number, pages_after_commit, *salts, first, second = _FRAME_HEADER.unpack_from(frame)
        sums = _checksum(frame[_FRAME_HEADER.size :], order, _checksum(frame[:8], order, sums))
        if salts != salts_and_sums[:2] or sums != (first, second):
            break
        written[number] = log.tell() - size
        if pages_after_commit:
            committed |= written
            written = {}
    return any(_read(log, at, size) != _read(database, (page - 1) * size, size) for page, at in committed.items())


def _read(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)


def _checksum(data: bytes, order: str, sums: tuple[int, int]) -> tuple[int, int]:
    """The checksum of a write-ahead log, continued over `data`."""
    (first, second), low = sums, 0xFFFFFFFF
    words = unpack(f"{order}{len(data) // 4}I", data)
    for one, two in zip(words[::2], words[1::2], strict=True):
        first = (first + one + second) & low
        second = (second + two + first) & low
    return first, second


SQLITE_MAGIC: Final = b"SQLite format 3\0"
_TABLES: Final = ("topics", "messages", "message_definitions")
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_SCHEMA_ENCODINGS: Final = ("ros2msg", "ros2idl")
_ALL: Final = "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED"
_SOME: Final = _ALL + " WHERE rowid BETWEEN ? AND ?"


def open_sqlite(
    path: Path, size: int, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Check the whole of a database of `size` bytes. `on_message` is called for each message, `progress` with bytes.

    Raises `RecordingError`.
    """
    _check_journals(path)
    _check_outline(path)
    segments: list[Segment] = []
    expansion, records, done = ExpansionCounter(limits), 0, 0
    with _opened(path, limits) as database:
        channels = _channels(database, limits)
        for run in _runs(database.execute(_ALL)):
            block = RecordingBlock(run[0].sequence, run[-1].sequence, sum(len(each.payload) for each in run))
            expansion.add(block)
            records += len(run)
            limits.check(messages=records, blocks=len(segments))
            for message in run:
                if (channel := channels.get(message.channel)) is None:
                    raise CorruptRecording(f"a message of the undefined topic {message.channel}")
                if on_message is not None:
                    on_message(channel, message.payload)
            segment = survey_block(len(segments), block, records=run)
            segments += [] if segment is None else [segment]
            done += block.size
            if progress is not None:
                progress(min(size, done), size)
    check_window(segments, limits)
    reading = partial(_reading, path, limits)
    return RecordingSource(path, "sqlite3", size, channels, tuple(segments), (), reading, unchecked=len(segments))


def _check_outline(path: Path) -> None:
    """Check that the schema is on the first page (of the kind 13, which has no pages below it): opening a database
    loads all of it into memory."""
    with path.open("rb") as file:
        head = file.read(108)
    if len(head) < 108:
        raise CorruptRecording("it is cut off in its first page")
    most = 64  # those of rosbag2 are seven, with the indexes
    if head[100] != 13 or int.from_bytes(head[103:105], "big") > most:
        raise NotARecording(f"it is a database of more than {most} tables, not one of rosbag2")


@contextmanager
def _opened(path: Path, limits: Limits) -> Iterator[sqlite3.Connection]:
    """The database, of which only the plain tables of rosbag2 can be read. SQLite's errors are `CorruptRecording`."""
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True, check_same_thread=False)) as database:
            database.text_factory = bytes
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.record)
            database.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, 16 << 10)  # of the definition of a table
            database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            for pragma in ("trusted_schema = OFF", "cell_size_check = ON", "query_only = ON"):
                database.execute(f"PRAGMA {pragma}")
            _check_tables(database)
            database.set_authorizer(_authorize)
            yield database
    except (sqlite3.Error, sqlite3.Warning, OverflowError) as error:
        raise CorruptRecording(f"SQLite can't read it: {error}") from None


def _authorize(action: int, table: str | None, _column: str | None, _database: str | None, _view: str | None) -> int:
    """Allow nothing but reading the columns of the tables that were checked; no function, no view."""
    if action == sqlite3.SQLITE_SELECT or (action == sqlite3.SQLITE_READ and table in _TABLES and _view is None):
        return sqlite3.SQLITE_OK
    return sqlite3.SQLITE_DENY


def _check_tables(database: sqlite3.Connection) -> None:
    """Check that the tables are plain ones: no view, no virtual table, no column that is computed."""
    found = database.execute("SELECT name, type, rootpage FROM sqlite_master").fetchall()
    tables = {name: (kind, page) for name, kind, page in found}
    if not {b"topics", b"messages"} <= tables.keys():
        raise NotARecording("it is a database without the tables of rosbag2")
    for table in _TABLES:
        kind, page = tables.get(table.encode(), (b"table", 1))
        if kind != b"table" or not page:
            raise CorruptRecording(f"{table} is not a table")
        if any(hidden for *_, hidden in database.execute(f"PRAGMA table_xinfo({table})")):
            raise CorruptRecording(f"{table} has columns that are computed")


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    """The columns of a table; none if there is no such table."""
    try:
        return {str(column[0]) for column in database.execute(f"SELECT * FROM {table} LIMIT 0").description}
    except sqlite3.OperationalError:
        return set()


def _channels(database: sqlite3.Connection, limits: Limits) -> dict[int, RecordingChannel]:
    """The topics by number, with the definitions of their types. Databases before ROS 2 Iron have none."""
    defined = 0
    definitions: dict[bytes, tuple[str, bytes]] = {}
    if _columns(database, "message_definitions"):
        rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        for name, encoding, text in rows:
            defined += sum(map(len, _all_bytes(name, encoding, text)))
            limits.check(definitions=defined, channels=len(definitions))
            definitions[name] = text_of(encoding), text
    columns = ["id", "name", "type", "serialization_format"]
    more = sorted({"offered_qos_profiles", "type_description_hash"} & _columns(database, "topics"))
    channels: dict[int, RecordingChannel] = {}
    for number, *texts in database.execute(f"SELECT {', '.join(columns + more)} FROM topics"):
        topic, kind, encoding, *about = _all_bytes(*texts)
        defined += sum(map(len, texts))
        limits.check(definitions=defined, channels=len(channels) + 1)
        schema, definition = definitions.get(kind, ("ros2msg", b""))
        if schema not in _SCHEMA_ENCODINGS:
            schema, definition = "", b""
        of = PayloadType(text_of(encoding), text_of(kind), schema, definition)
        metadata = {name: text_of(text) for name, text in zip(more, about, strict=True)}
        if number in channels:
            raise CorruptRecording(f"two topics have the number {number}")
        channels[number] = RecordingChannel(text_of(topic), of, metadata)
    return channels


def _all_bytes(*values: Any) -> tuple[bytes, ...]:
    if not all(isinstance(value, bytes) for value in values):
        raise CorruptRecording("a description of a topic or a type is not a text")
    return values


def _runs(rows: Iterator[Any]) -> Iterator[list[RecordedMessage]]:
    """The messages in runs of about `RUN` bytes. Their sequence numbers are their rows."""
    run: list[RecordedMessage] = []
    size = 0
    before = -(1 << 63) - 1
    for row, topic, time, data in rows:
        if not (isinstance(topic, int) and isinstance(time, int) and isinstance(data, bytes)) or time < 0:
            raise CorruptRecording(f"the message in row {row} has a field of a wrong type")
        if row <= before:
            raise CorruptRecording("its rows are out of order")
        if data.startswith(ZSTD_MAGIC):
            raise NotARecording("its messages are compressed one by one; convert it first: ros2 bag convert")
        if run and (size + len(data) > RUN or len(run) >= 4096):
            yield run
            run, size = [], 0
        run.append(RecordedMessage(topic, row, time, time, data))
        size, before = size + len(data), row
    if run:
        yield run


@contextmanager
def _reading(path: Path, limits: Limits) -> Iterator[BlockReader]:
    """Open the database to read its messages, by rows."""
    with _opened(path, limits) as database:

        def read(block: RecordingBlock) -> Iterator[RecordedMessage]:
            rows = database.execute(_SOME, (block.offset, block.stored))
            for run in _runs(rows):
                yield from run

        yield read
