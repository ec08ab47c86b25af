"""The bridge's journal: files of earlier versions."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING, Final

from bridges.ipfs.journal import RelayJournal, Side
from bridges.ipfs.publish_queue import QueuedMessage
from bridges.ipfs.validation import RelayMessage

if TYPE_CHECKING:
    from pathlib import Path

HASH: Final = "ab" * 32
OLD: Final = """
    CREATE TABLE waiting (
        fingerprint BLOB, key TEXT, payload BLOB, legacy BLOB, side TEXT, shared INTEGER,
        PRIMARY KEY (fingerprint, side));
"""
KEYS: Final = {
    f"aira/a.eth/demand/Qm/{HASH}": ("aira/a.eth/demand/Qm", HASH),
    f"aira/a.eth/offer/Qm/{HASH}": ("aira/a.eth/offer/Qm", HASH),
    f"aira/a.eth/result/0x11/{HASH}": ("aira/a.eth/result", HASH),
    f"aira/a.eth/feedback/{HASH}/{HASH}": ("aira/a.eth/feedback", ""),
    f"aira/a.eth/pending/{HASH}": ("aira/a.eth/pending", ""),
}


def waiting(journal: RelayJournal) -> list[tuple[str, str]]:
    return [(queued.message.key, queued.message.hash) for _, queued in journal.waiting()]


def test_messages_that_waited_under_keys_with_a_hash_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    with sqlite3.connect(path) as old:
        old.executescript(OLD)
        rows = [(bytes([number]), key, b"p", b"l", "ipfs", 0) for number, key in enumerate(KEYS)]
        old.executemany("INSERT INTO waiting VALUES (?, ?, ?, ?, ?, ?)", rows)
    old.close()
    message = RelayMessage(b"new", "aira/a.eth/result", b"p", b"l", "cd" * 32)
    with RelayJournal(path) as journal:
        assert waiting(journal) == list(KEYS.values())
        journal.add_waiting(Side.MESH, QueuedMessage(message, shared=False, left_to=None, since=0.0))
    with RelayJournal(path) as journal:
        assert waiting(journal) == [*KEYS.values(), (message.key, message.hash)]
        assert next(reversed(list(journal.waiting())))[1].message == message
