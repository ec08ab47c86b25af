"""Which files of a data folder are the state of its agents, and the errors of the commands on it.

    0x…/1-5f3a…/ledger.sqlite               jobs, outbox and cursor of an account on one chain
    0x…/1-5f3a…/verdicts.sqlite             what a validator judged and signed, and its cursor
    0x…/1-5f3a…/withdrawals-NAME.sqlite     withdrawals that the provider of the lighthouse NAME knows
    0x…/1-5f3a…/sent-orders-NAME.sqlite     orders of its transactions that may still be mined
    0x…/1-5f3a…/recordings/0x….mcap.part    recordings of running jobs
    0x…/content/Qm…                         files by their CID, and `.pins` beside them
    transactions/1-5f3a…/0x…/….jsonl        pending transactions

Keyfiles and passwords are not part of it, and so never in a backup. Other files are never changed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError, InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

LEDGER: Final = "ledger.sqlite"
VERDICTS: Final = "verdicts.sqlite"
WITHDRAWALS: Final = "withdrawals-"
SENT_ORDERS: Final = "sent-orders-"
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
    rf"(?P<part>{_ADDRESS})/(?:{_CHAIN}/(?:(?:ledger|verdicts|(?:{WITHDRAWALS}|{SENT_ORDERS})[^/\0]+)\.sqlite"
    rf"|recordings/{_ADDRESS}\.mcap(?:\.part|\.cut)?)"
    rf"|content/(?:{_CID}|\.pins/{_CID}/[A-Za-z0-9_-]{{1,64}}))"
)
_TRANSACTION: Final = re.compile(rf"(?P<part>transactions/{_CHAIN}/{_ADDRESS})/[0-9]{{12}}\.jsonl")
_PART: Final = re.compile(rf"(?:transactions/{_CHAIN}/)?{_ADDRESS}")
_ADDRESS_NAME: Final = re.compile(_ADDRESS)
_CHAIN_NAME: Final = re.compile(_CHAIN)


class ArchiveUnusable(InputError, code="archive-unusable"):
    """A file is not a backup, is damaged, or contains unexpected files. Nothing of it was used.

    `reason` is `unreadable`, `not-a-backup`, `damaged`, `truncated`, `other-version`, `unexpected-part`,
    `unexpected-file`, `not-a-file`, `too-many-files`, `too-long`, `wrong-checksum`, `trailing-data` or `no-space`.
    """

    def __init__(
        self, path: Path, reason: str, why: str, *, hint: str = "use another backup; nothing was changed"
    ) -> None:
        super().__init__(f"{path} can't be used: {why}", hint=hint)
        self.path = path
        self.reason = reason


class StateInUse(ConfigurationError, code="state-in-use"):
    """A process is using the state that should be replaced."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is in use", hint="stop the process that uses it first")
        self.path = path


class StateExists(ConfigurationError, code="state-exists"):
    """The data folder already has a state."""

    def __init__(self, folder: Path, parts: Sequence[str]) -> None:
        super().__init__(
            f"{folder} already has a state: {', '.join(parts)}",
            hint="use another folder with --data-dir, or move the old state aside with --existing set-aside",
        )
        self.folder = folder
        self.parts = tuple(parts)


class NoState(ConfigurationError, code="state-missing"):
    """The data folder has no state."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} has no state of an agent", hint="give the data folder with --data-dir")
        self.folder = folder


class StateChanging(ConfigurationError, code="state-changing"):
    """Jobs started and ended faster than they could be copied."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"the jobs of {path} change too fast to be copied", hint="try again, or stop the agent")
        self.path = path


class TooManyFiles(ConfigurationError, code="too-many-files"):
    """A data folder has more files than a backup can list."""

    def __init__(self, count: int) -> None:
        super().__init__(
            f"{count:,} files are more than a backup can list",
            hint="exclude content that agents can fetch again: --content needed, or none",
        )
        self.count = count


class DataFolderUnwritable(ConfigurationError, code="data-folder-unwritable"):
    """A backup can't be restored to a folder."""

    def __init__(self, folder: Path, why: str | None) -> None:
        super().__init__(
            f"can't restore to {folder}: {why}", hint="give this user write access, or use another --data-dir"
        )
        self.folder = folder


@dataclass(frozen=True)
class AccountFolder:
    """The folder of an account in a data folder."""

    folder: Path

    @property
    def address(self) -> str:
        """The account's address."""
        return self.folder.name

    @property
    def content(self) -> Path:
        """Its files by CID."""
        return self.folder / CONTENT

    @property
    def chains(self) -> tuple[Path, ...]:
        """The folders of the chains on which the account has a database."""
        named = (path for path in _folders(self.folder) if _CHAIN_NAME.fullmatch(path.name))
        return tuple(path for path in named if any(path.glob("*.sqlite")))


def provider_files_in(chain: Path) -> tuple[Path, ...]:
    """What an account's folder for a chain has of its providers."""
    return tuple(path for name in (WITHDRAWALS, SENT_ORDERS) for path in sorted(chain.glob(f"{name}*.sqlite")))


def lighthouses_in(chain: Path) -> tuple[str, ...]:
    """The lighthouses that an account is, or was, a provider of on a chain."""
    return tuple(path.stem.removeprefix(WITHDRAWALS) for path in sorted(chain.glob(f"{WITHDRAWALS}*.sqlite")))


def account_folders(folder: Path) -> tuple[AccountFolder, ...]:
    """The accounts that have files in a data folder."""
    return tuple(AccountFolder(path) for path in _folders(folder) if _ADDRESS_NAME.fullmatch(path.name))


def transactions_in(folder: Path) -> tuple[Path, ...]:
    """The files of pending transactions in a data folder, of all accounts."""
    return tuple(
        path
        for path in sorted((folder / TRANSACTIONS).glob("*/*/*.jsonl"))
        if part_of(path.relative_to(folder).as_posix()) is not None
    )


def parts_in(folder: Path) -> tuple[str, ...]:
    """The parts that a data folder has; see `part_of`."""
    sent = {path.parent.relative_to(folder).as_posix() for path in transactions_in(folder)}
    return (*sorted(sent), *(home.address for home in account_folders(folder)))


def part_of(name: str) -> str | None:
    """The part of the state that a file belongs to, by its name in a backup: an account's folder, or the folder of its
    transactions on one chain. None if it is not a file of a state.

    A part is restored as a whole. No accepted name can escape the folder.
    """
    found = _ACCOUNT_FILE.fullmatch(name) or _TRANSACTION.fullmatch(name)
    return found["part"] if found else None


def is_part(name: str) -> bool:
    """Whether this is a valid name of a part."""
    return _PART.fullmatch(name) is not None


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
