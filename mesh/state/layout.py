"""What of a data folder is the state of its agents: which files, by their names. Everything else stays where it is.

    0x…/1-5f3a…/ledger.sqlite               jobs, outbox and cursor of an account on one chain
    0x…/1-5f3a…/recordings/0x….mcap.part    what running jobs have recorded
    0x…/content/Qm…                         files by their CID, and `.pins` beside them
    transactions/1-5f3a…/0x…/….jsonl        transactions that were sent and are not settled

Keyfiles and passwords have no place in there, and so none in a backup.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LEDGER: Final = "ledger.sqlite"
RECORDINGS: Final = "recordings"
CONTENT: Final = "content"
PINS: Final = ".pins"
TRANSACTIONS: Final = "transactions"
STAGES: Final = (".mcap.cut", ".mcap.part", ".mcap")
"""How the file of a recording ends while it is gone on with, made, and whole: in this order it goes from one to the
next, so that who looks for them in it misses none."""

_ADDRESS: Final = r"0x[0-9a-fA-F]{40}"
_CHAIN: Final = r"[0-9]{1,20}-[0-9a-f]{8,64}"
_CID: Final = r"Qm[1-9A-HJ-NP-Za-km-z]{44}"
_ACCOUNT_FILE: Final = re.compile(
    rf"(?P<part>{_ADDRESS})/(?:{_CHAIN}/(?:ledger\.sqlite|recordings/{_ADDRESS}\.mcap(?:\.part|\.cut)?)"
    rf"|content/(?:{_CID}|\.pins/{_CID}/[A-Za-z0-9_-]{{1,64}}))"
)
_TRANSACTION: Final = re.compile(rf"(?P<part>transactions/{_CHAIN}/{_ADDRESS})/[0-9]{{12}}\.jsonl")
_PART: Final = re.compile(rf"(?:transactions/{_CHAIN}/)?{_ADDRESS}")
_ADDRESS_NAME: Final = re.compile(_ADDRESS)
_CHAIN_NAME: Final = re.compile(_CHAIN)


@dataclass(frozen=True)
class Home:
    """The folder of one account in a data folder."""

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
        """The folders of the chains on which it has a ledger."""
        return tuple(
            path for path in _folders(self.folder) if _CHAIN_NAME.fullmatch(path.name) and (path / LEDGER).is_file()
        )


def homes_in(folder: Path) -> tuple[Home, ...]:
    """The accounts that have files in a data folder."""
    return tuple(Home(path) for path in _folders(folder) if _ADDRESS_NAME.fullmatch(path.name))


def transactions_in(folder: Path) -> tuple[Path, ...]:
    """The files of transactions under way in a data folder, of all accounts."""
    return tuple(
        path
        for path in sorted((folder / TRANSACTIONS).glob("*/*/*.jsonl"))
        if part_of(path.relative_to(folder).as_posix()) is not None
    )


def parts_in(folder: Path) -> tuple[str, ...]:
    """The parts that a data folder has; see `part_of`."""
    sent = {path.parent.relative_to(folder).as_posix() for path in transactions_in(folder)}
    return (*sorted(sent), *(home.address for home in homes_in(folder)))


def part_of(name: str) -> str | None:
    """Which part of a state a file belongs to, by its name in a backup: an account's folder, or that of its
    transactions on one chain. None for what is no file of a state.

    A part comes and goes as a whole. No name that this knows leads out of the folder.
    """
    found = _ACCOUNT_FILE.fullmatch(name) or _TRANSACTION.fullmatch(name)
    return found["part"] if found else None


def is_part(name: str) -> bool:
    """Whether a part of a state can be called so."""
    return _PART.fullmatch(name) is not None


def pin_name(address: str, cid: str, label: str) -> str:
    """What a pin is called in a backup: headers of a tar have no room for a file's name of 111 letters."""
    return f"{address}/{CONTENT}/{PINS}/{cid}/{label}"


def place_of(name: str) -> str:
    """Where a file of a backup belongs, as a path under the data folder."""
    folder, pin, label = name.rpartition("/")
    return f"{folder}.{label}" if pin and f"/{CONTENT}/{PINS}/" in folder else name


def _folders(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        yield from sorted(path for path in folder.iterdir() if path.is_dir() and not path.is_symlink())
