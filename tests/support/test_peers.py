from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.peers import require

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(autouse=True)
def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AIRA_PEERS_CACHE", str(tmp_path))
    monkeypatch.delenv("AIRA_REQUIRE_PEERS", raising=False)
    monkeypatch.delenv("AIRA_MCAP", raising=False)


def test_a_missing_peer_skips_the_test_with_the_reason() -> None:
    with pytest.raises(pytest.skip.Exception, match="anvil: not installed: run `make peers`"):
        require("anvil")


def test_a_missing_peer_fails_the_test_if_all_are_required(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AIRA_REQUIRE_PEERS", "1")
    with pytest.raises(pytest.fail.Exception, match="zenohd: not installed"):
        require("zenohd")


def test_a_peer_without_a_recipe_is_skipped_even_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AIRA_REQUIRE_PEERS", "1")
    with pytest.raises(pytest.skip.Exception, match="AIRA_MCAP=/path/to/mcap"):
        require("mcap")


def test_the_caller_can_name_an_mcap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "mcap"
    program.touch()
    monkeypatch.setenv("AIRA_MCAP", str(program))
    assert require("mcap") == program
