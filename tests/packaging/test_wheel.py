"""A wheel with the base dependencies only: every command and import works, or names the extra that it needs."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import venv
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mesh.base.extras import install
from tests.support.commands import environment

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
WALKER = Path(__file__).with_name("every_command.py")
NAME = re.compile(r"[A-Za-z0-9._-]+")
IMPORTS = """
import bridges.serial, json, mesh
failed = {}
for package in (mesh, bridges.serial):
    for name in package.__all__:
        try:
            getattr(package, name)
        except ImportError as error:
            failed[name] = [type(error).__name__, str(error), getattr(error, "hint", "")]
print(json.dumps(failed))
"""
AGENT = """
from mesh import Agent, Settings
Agent("QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82", settings=Settings(keyfile="some.json")).run()
"""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment that has a wheel of this tree, the base dependencies, and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for part in ("mesh", "bridges", "schemas"):
        shutil.copytree(ROOT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    for part in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / part, source)
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
    options = ("--no-deps", "--no-build-isolation", "--no-index")
    subprocess.run([*pip, "wheel", *options, "--wheel-dir", folder, source], check=True, timeout=300)
    venv.create(folder / "env")
    python = folder / "env" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "--python", python, "install", "--no-deps", "--no-index", wheel], check=True, timeout=300)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = Path(subprocess.run([python, "-c", where], check=True, capture_output=True, text=True).stdout.strip())
    for one in required_by(distribution("aira-mesh"), set()):
        copy(one, packages)
    return python


def required_by(one: Distribution, seen: set[str]) -> Iterator[Distribution]:
    """What a distribution requires without extras, and what that requires."""
    for requirement in one.requires or ():
        name = NAME.match(requirement)
        assert name is not None
        if "extra ==" in requirement or name[0] in seen:
            continue
        seen.add(name[0])
        try:
            found = distribution(name[0])
        except ModuleNotFoundError:
            continue  # for another Python or system
        yield found
        yield from required_by(found, seen)


def copy(one: Distribution, target: Path) -> None:
    for file in one.files or ():
        if ".." not in file.parts:
            (target / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(str(one.locate_file(file)), target / file)


def in_base(base: Path, *arguments: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    variables = environment({"HOME": str(folder), "XDG_DATA_HOME": "", "XDG_CONFIG_HOME": ""})
    return subprocess.run(
        [base, *arguments], cwd=folder, env=variables, capture_output=True, text=True, timeout=240, check=False
    )


@pytest.mark.full
def test_every_command_works_or_names_its_extra(base: Path, tmp_path: Path) -> None:
    done = in_base(base, WALKER, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    ran = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(ran) > 50
    missing = 0
    for one in ran:
        assert "Traceback" not in one["stderr"], one
        assert "ModuleNotFoundError" not in one["stderr"], one
        assert one["code"] in (None, 0, 1, 2), one
        if "[package-missing]" in one["stderr"]:
            missing += 1
            assert one["code"] in (1, 2)
            assert "pip install '.[" in one["stderr"], one
    assert missing > 5


def test_each_public_name_can_be_imported_or_names_its_extra(base: Path, tmp_path: Path) -> None:
    done = in_base(base, "-c", IMPORTS, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    for name, (kind, _, hint) in json.loads(done.stdout).items():
        assert (name, kind) == (name, "PackageMissing")
        assert (name, hint) == (name, install("serial" if name.endswith("simulated_board") else "chain"))


def test_an_agent_with_a_keyfile_names_the_extra(base: Path, tmp_path: Path) -> None:
    done = in_base(base, "-c", AGENT, folder=tmp_path)
    assert done.returncode == 2
    first, second = done.stderr.splitlines()
    assert first.endswith("[package-missing]")
    assert second.strip() == install("chain")


@pytest.mark.parametrize("words", [["--version"], ["cid", "it"]])
def test_python_m_mesh_works_beside_folders_of_the_same_names(base: Path, tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "it").write_text("a lamp")
    for name, file in (("schemas", "__init__.py"), ("bridges", "__init__.py"), ("mesh", "notes.txt")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).touch()
    done = in_base(base, "-m", "mesh", *words, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_program_beside_another_schemas_is_told_which_folder_hides_ours(base: Path, tmp_path: Path) -> None:
    (tmp_path / "schemas").mkdir()
    (tmp_path / "schemas" / "__init__.py").touch()
    done = in_base(base, "-c", "import mesh", folder=tmp_path)
    assert done.stderr.splitlines()[-1].startswith("ImportError: ")
    assert str(tmp_path / "schemas") in done.stderr.splitlines()[-1]


def test_another_package_mesh_is_named_by_python(base: Path, tmp_path: Path) -> None:
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh" / "__init__.py").touch()
    done = in_base(base, "-m", "mesh", "--version", folder=tmp_path)
    assert done.returncode == 1
    assert "mesh.__main__" in done.stderr
    assert in_base(base, "-P", "-m", "mesh", "--version", folder=tmp_path).returncode == 0
