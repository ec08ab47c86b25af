"""What a data folder, or a backup, holds of agents: for people who look before they act."""

from __future__ import annotations

import asyncio
import io
import tempfile
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from mesh.content import Store
from mesh.content.recovery import is_in_use
from mesh.state.archive import read_archive
from mesh.state.errors import NoState
from mesh.state.layout import LEDGER, PINS, RECORDINGS, homes_in, parts_in, transactions_in
from mesh.state.ledgers import copy_ledger, read_ledger

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.state.archive import About
    from mesh.state.layout import Home

_KINDS: Final = {LEDGER: "ledgers", "mcap": "recordings", "jsonl": "transactions"}


class ChainState(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """An account's state on one chain. `block` is the last one handled, None before the first; `waiting` messages are
    in the outbox, and so many `recordings` under way."""

    chain: str
    block: int | None
    jobs: dict[str, int]
    waiting: int
    recordings: int


class AccountState(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """An account's state. Of its content the number of files, their bytes, and those of pinned ones."""

    address: str
    in_use: bool
    chains: tuple[ChainState, ...]
    files: int
    bytes: int
    pinned_bytes: int


class Inventory(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """A data folder. `transactions` of all its accounts were sent and are not settled."""

    folder: str
    accounts: tuple[AccountState, ...]
    transactions: int


class ArchiveContents(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """A backup that is whole: what it says of itself, how many files of each kind it has, and their bytes."""

    made: str
    software: str
    content: str
    parts: tuple[str, ...]
    files: dict[str, int]
    bytes: int


async def take_inventory(folder: Path) -> Inventory:
    """Look at a data folder, whose agents may run. Raises `NoState`, `LedgerUnusable`, `StoreDamaged`."""
    if not parts_in(folder):
        raise NoState(folder)
    return Inventory(
        folder=str(folder),
        accounts=tuple([await _account(home) for home in homes_in(folder)]),
        transactions=len(transactions_in(folder)),
    )


def examine_archive(path: Path) -> ArchiveContents:
    """Read a whole backup and compare it with its checksums. Raises `ArchiveUnusable`."""
    kinds: Counter[str] = Counter()
    size = 0

    @contextmanager
    def count(name: str, length: int) -> Iterator[_Nowhere]:
        nonlocal size
        kinds[_kind(name)] += 1
        size += length
        yield _Nowhere()

    about: About = read_archive(path, count)
    return ArchiveContents(
        made=about.made,
        software=about.software,
        content=about.content,
        parts=about.parts,
        files=dict(sorted(kinds.items())),
        bytes=size,
    )


class _Nowhere(io.RawIOBase):
    """Takes everything and keeps nothing."""

    def write(self, data: object, /) -> int:
        return 0


def _kind(name: str) -> str:
    """What a file of a state is, in a word."""
    path = Path(name)
    if PINS in path.parts:
        return "pins"
    return next((kind for ending, kind in _KINDS.items() if ending in path.name), "content")


async def _account(home: Home) -> AccountState:
    in_use = home.content.is_dir() and is_in_use(home.content)
    chains = tuple([await _chain(folder) for folder in home.chains])
    files, size, pinned = await asyncio.to_thread(_content, home)
    return AccountState(
        address=home.address, in_use=in_use, chains=chains, files=files, bytes=size, pinned_bytes=pinned
    )


async def _chain(folder: Path) -> ChainState:
    with tempfile.TemporaryDirectory(prefix="aira-state-") as scratch:
        copy = Path(scratch) / LEDGER
        await asyncio.to_thread(copy_ledger, folder / LEDGER, copy)
        facts = await read_ledger(copy)
    return ChainState(
        chain=folder.name,
        block=facts.block,
        jobs=dict(facts.phases),
        waiting=facts.waiting,
        recordings=len(list((folder / RECORDINGS).glob("*.mcap*"))),
    )


def _content(home: Home) -> tuple[int, int, int]:
    if not home.content.is_dir():
        return 0, 0, 0
    with Store(home.content) as store:
        usage = store.usage()
    return usage.files, usage.bytes, usage.pinned_bytes
