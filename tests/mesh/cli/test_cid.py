"""`aira cid`."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.cli import main
from schemas import cid_of_bytes
from tests.support.commands import aira, refused, run

if TYPE_CHECKING:
    from click.testing import Result

CONTENT = b"a behaviour model\n"


def cid(*arguments: str | Path, given: bytes | None = None) -> Result:
    return CliRunner().invoke(main, ["cid", *map(str, arguments)], input=None if given is None else io.BytesIO(given))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "model.md"
    path.write_bytes(CONTENT)
    return path


def test_for_one_file_only_its_cid_is_printed(file: Path) -> None:
    done = cid(file)
    assert (done.exit_code, done.stdout) == (0, f"{cid_of_bytes(CONTENT)}\n")


def test_for_programs_an_object_each_is_printed(file: Path) -> None:
    done = cid(file, file, "--json")
    said = {"cid": cid_of_bytes(CONTENT), "file": str(file)}
    assert [json.loads(line) for line in done.stdout.splitlines()] == [said, said]


def test_for_several_files_a_line_each_is_printed(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_bytes(b"")
    done = cid(file, other)
    assert done.stdout == f"{cid_of_bytes(CONTENT)}  {file}\n{cid_of_bytes(b'')}  {other}\n"


def test_a_dash_reads_the_standard_input() -> None:
    assert cid("-", given=CONTENT).stdout == f"{cid_of_bytes(CONTENT)}\n"


def test_a_folder_is_one_clear_line(tmp_path: Path) -> None:
    done = cid(tmp_path)
    refused(done, "file-unreadable", tmp_path, "Is a directory")


def test_the_script_and_the_module_do_the_same(file: Path) -> None:
    expected = f"{cid_of_bytes(CONTENT)}\n"
    assert aira("cid", file).stdout == expected
    script = run(Path(sys.executable).with_name("aira"), "cid", file)
    assert script.stdout == expected


def test_it_does_not_import_the_chain_or_the_network(file: Path) -> None:
    program = (
        "import sys; from mesh.cli import main\n"
        f"main(['cid', {str(file)!r}], standalone_mode=False)\n"
        "print([name for name in ('web3', 'zenoh', 'asyncio', 'rich') if name in sys.modules])"
    )
    assert run(sys.executable, "-c", program).stdout.splitlines()[1] == "[]"
