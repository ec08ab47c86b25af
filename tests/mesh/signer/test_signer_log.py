"""The log: what was changed in it is found, it stays bounded, and a crash loses nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.errors import AiraError
from mesh.signer._kept import Budget, SignerLog, log_files, verify_log
from schemas import Signer, keccak256

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

SIGNER = Signer(keccak256(b"the key of a log"))
OTHER = Signer(keccak256(b"another key"))


@pytest.fixture
def budget(tmp_path: Path) -> Iterator[Budget]:
    budget = Budget(tmp_path / "budget.sqlite")
    budget.open(SIGNER.address)
    yield budget
    budget.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "log"


def written(folder: Path, budget: Budget, entries: int = 5, **options: int) -> SignerLog:
    log = SignerLog(folder, SIGNER, budget, **options)
    log.open()
    for number in range(entries):
        log.add("allowed", cost=number)
    return log


def lines_of(folder: Path) -> list[bytes]:
    return (log_files(folder)[-1]).read_bytes().splitlines()


def signed_by_another(lines: list[bytes]) -> list[bytes]:
    import msgspec

    from mesh.signer._kept import SignedEntry
    from schemas.decoding import decode_json

    entry = msgspec.structs.replace(decode_json(lines[2], SignedEntry), facts={"cost": 0}, signature="")
    entry = msgspec.structs.replace(entry, signature=OTHER.sign_hash(entry.digest).hex())
    return [*lines[:2], msgspec.json.encode(entry), *lines[3:]]


@pytest.mark.parametrize(
    ("tamper", "fault"),
    [
        (lambda lines: lines, ""),
        (lambda lines: [*lines[:2], lines[2].replace(b'"cost":2', b'"cost":3'), *lines[3:]], "entry 3 was changed"),
        (lambda lines: [*lines[:2], *lines[3:]], "entry 3 is missing"),
        (lambda lines: [lines[1], lines[0], *lines[2:]], "entry 1 is missing"),
        (lambda lines: lines[:-1], "the log ends with entry 4, and entry 5 was the last one"),
        (lambda lines: lines[1:], "entry 1 is missing"),
        (lambda lines: [*lines, lines[-1]], "entry 6 is missing"),
        (lambda lines: [*lines[:2], b"{", *lines[3:]], "entry 3 is unreadable"),
        (
            lambda lines: [*lines[:2], lines[2].replace(b'{"number"', b'{ "number"'), *lines[3:]],
            "entry 3 is unreadable",
        ),
        (signed_by_another, "entry 3 was changed: it is not signed by"),
        (lambda lines: [], "the log ends with entry 0"),
    ],
)
def test_what_was_changed_is_found(
    folder: Path, budget: Budget, tamper: Callable[[list[bytes]], list[bytes]], fault: str
) -> None:
    written(folder, budget)
    assert verify_log(folder, SIGNER.address, budget.log_head()) == ""
    (path,) = log_files(folder)
    path.write_bytes(b"".join(line + b"\n" for line in tamper(lines_of(folder))))
    found = verify_log(folder, SIGNER.address, budget.log_head())
    assert found.startswith(fault), found
    assert bool(found) == bool(fault)


def test_a_log_of_which_all_entries_are_signed_anew_ends_elsewhere(
    folder: Path, budget: Budget, tmp_path: Path
) -> None:
    written(folder, budget)
    other = Budget(tmp_path / "other.sqlite")
    other.open(SIGNER.address)
    written(tmp_path / "forged", other)
    forged, (path,) = log_files(tmp_path / "forged")[0], log_files(folder)
    path.write_bytes(forged.read_bytes())
    other.close()
    assert verify_log(folder, SIGNER.address, budget.log_head()) == "entry 5 is another one than the database says"


def test_a_log_that_grows_while_it_is_verified_holds(folder: Path, budget: Budget) -> None:
    log = written(folder, budget)
    head = budget.log_head()
    log.add("allowed", cost=5)
    assert verify_log(folder, SIGNER.address, head, latest=lambda: budget.log_head().last) == ""
    assert verify_log(folder, SIGNER.address, head).startswith("the log ends with entry 6")


def test_a_log_is_bounded_and_its_chain_holds(folder: Path, budget: Budget) -> None:
    log = written(folder, budget, 200, file_bytes=2000, files=3)
    assert len(log_files(folder)) == 3
    assert budget.log_head().first > 100
    assert verify_log(folder, SIGNER.address, budget.log_head()) == ""
    assert [entry.number for entry in log.entries(limit=3)] == [198, 199, 200]
    log_files(folder)[0].unlink()
    assert "is missing" in verify_log(folder, SIGNER.address, budget.log_head())


@pytest.mark.parametrize("kept", [0, 10])
def test_an_entry_that_a_crash_kept_from_the_file_is_written_when_it_is_opened(
    folder: Path, budget: Budget, kept: int
) -> None:
    log = written(folder, budget)
    (path,), lines = log_files(folder), lines_of(folder)
    path.write_bytes(b"".join(line + b"\n" for line in lines[:-1]) + lines[-1][:kept])
    log.open()
    assert lines_of(folder) == lines
    path.write_bytes(b"".join(line + b"\n" for line in lines[:-2]))
    with pytest.raises(AiraError) as caught:
        log.open()
    assert caught.value.code == "log-unusable"
