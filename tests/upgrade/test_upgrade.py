"""This version opens what earlier ones kept, and refuses what a later one has written."""

from __future__ import annotations

import tarfile
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from bridges.ipfs._relay import RelayJournal
from mesh.agent.ledger import Ledger, Phase
from mesh.base.database import VERSION
from mesh.chain import Account
from mesh.chain._pending import FILE, TransactionStore
from mesh.content import Store
from mesh.errors import ConfigurationError
from mesh.market.store import MarketStore
from mesh.ops.state import take_inventory
from mesh.validator.ledger import VerdictLedger
from tests.support.agent.ledgers import mark_as_version
from tests.support.commands import aira

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

SAMPLES = sorted(Path(__file__).parent.glob("*.tar.gz"))


@pytest.fixture(params=SAMPLES, ids=[path.name.removesuffix(".tar.gz") for path in SAMPLES])
def kept(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """What a version kept: a data folder and a settings file (see `make.py`)."""
    with tarfile.open(request.param) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def found(kept: Path, pattern: str) -> Path:
    (path,) = kept.glob(f"data/{pattern}")
    return path


async def test_the_state_of_an_earlier_version_is_opened(kept: Path) -> None:
    """By each role whose it is: the job is paid, its files are there, its orders are known, and nothing is pending."""
    development = kept / "data" / "development"
    robot = Account.from_keyfile(development / "robot.json", development / "password").address
    person = Account.from_keyfile(development / "person.json", development / "password").address
    assert {one.address for one in (await take_inventory(kept / "data")).accounts} >= {robot, person}
    async with Ledger(found(kept, f"{robot}/*/ledger.sqlite")) as ledger:
        (job,) = await ledger.jobs(frozenset(Phase))
        assert (await ledger.cursor())[0]
    assert job.phase is Phase.FINALIZED
    for address in (robot, person):
        with Store(kept / "data" / address / "content") as store:
            assert store.checked(job.liability.objective)
            assert not store.check().damaged
    with MarketStore(found(kept, "*/*/provider-*.3.*.sqlite")) as market:
        assert market.sent_orders() + market.sent_orders(contracts=True)
    with closing(TransactionStore(found(kept, f"transactions/*/{person.lower()}"))) as transactions:
        assert transactions.read() == ({}, frozenset())


def test_the_settings_of_an_earlier_version_are_read_or_the_options_that_are_gone_are_named(kept: Path) -> None:
    done = aira("settings", "--config", kept / "aira.toml", "--json")
    assert done.returncode == 0 or "unknown-option" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr


def test_a_backup_of_an_earlier_version_is_made_and_shown(kept: Path, tmp_path: Path) -> None:
    """As before an upgrade: with the commands."""
    for words in (("backup", tmp_path / "it.tar.gz"), ("show",)):
        done = aira("state", *words, "--data-dir", kept / "data")
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "open_file"),
    [
        (".blocks.sqlite", lambda path: Store(path.parent)),
        (FILE, lambda path: closing(TransactionStore(path.parent))),
        ("provider.sqlite", MarketStore),
        ("journal.sqlite", RelayJournal),
    ],
)
def test_a_file_that_a_later_version_wrote_is_refused(
    tmp_path: Path, name: str, open_file: Callable[[Path], AbstractContextManager[object]]
) -> None:
    path = tmp_path / "state" / name
    path.parent.mkdir()
    with open_file(path):
        pass
    mark_as_version(path, VERSION + 1)
    before = path.read_bytes()
    with (
        pytest.raises(ConfigurationError, match=f"format {VERSION + 1}, this one knows {VERSION}") as refused,
        open_file(path),
    ):
        pass
    assert refused.value.code == "state-too-new"
    assert path.read_bytes() == before


@pytest.mark.parametrize("ledger", [Ledger, VerdictLedger])
async def test_a_ledger_that_a_later_version_wrote_is_refused(
    tmp_path: Path, ledger: type[Ledger] | type[VerdictLedger]
) -> None:
    async with ledger(tmp_path / "ledger.sqlite"):
        pass
    mark_as_version(tmp_path / "ledger.sqlite", VERSION + 1)
    with pytest.raises(ConfigurationError) as refused:
        async with ledger(tmp_path / "ledger.sqlite"):
            pass
    assert refused.value.code == "state-too-new"


def test_a_command_says_in_one_line_that_a_later_version_wrote_its_state(kept: Path) -> None:
    mark_as_version(found(kept, "0x7099*/*/ledger.sqlite"), VERSION + 1)
    done = aira("state", "show", "--data-dir", kept / "data")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 2  # the hint is on a line of its own
    assert "was written by a newer version" in done.stderr
    assert "[state-too-new]" in done.stderr
