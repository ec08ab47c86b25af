"""Servers of bridges: certificates that can't be used, and by which names a door is reached."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bridges.serving import DoorOptions, ServerOptions
from mesh.errors import ConfigurationError
from tests.support.commands import invoke, refused

if TYPE_CHECKING:
    from pathlib import Path

DOORS = [
    ("mcp", "--http", "127.0.0.1:0"),
    ("a2a", "--http", "127.0.0.1:0"),
]


@pytest.mark.parametrize(
    ("certificate", "key", "why"),
    [("nothing.pem", "nothing.key", "No such file"), ("no.pem", "no.pem", "not a certificate"), ("no.pem", "", "none")],
)
def test_a_certificate_that_can_not_be_used_is_an_error(tmp_path: Path, certificate: str, key: str, why: str) -> None:
    (tmp_path / "no.pem").write_text("no certificate")
    options = ServerOptions(certificate=str(tmp_path / certificate), key=str(tmp_path / key) if key else "")
    with pytest.raises(ConfigurationError, match=why) as caught:
        options.tls()
    assert caught.value.code == "tls-unusable"


@pytest.mark.parametrize("words", DOORS, ids=" ".join)
def test_a_door_says_so_in_one_line(tmp_path: Path, words: tuple[str, ...]) -> None:
    files = ("--certificate", tmp_path / "nothing.pem", "--key", tmp_path / "nothing.key")
    done = invoke(*words, *files, "--data-dir", tmp_path)
    refused(done, ConfigurationError, code="tls-unusable")


@pytest.mark.parametrize(
    ("host", "is_known"),
    [
        ("127.0.0.1", True),
        ("LOCALHOST:80", True),
        ("[::1]:80", True),
        ("10.0.0.7:80", True),
        ("robots.example", True),
        ("Door.Example:443", True),
        ("other.example", False),
        ("127.0.0.1.other.example", False),
        ("", False),
        ("[", False),
    ],
)
def test_a_door_is_reached_by_its_names_only(host: str, is_known: bool) -> None:
    options = DoorOptions(host="10.0.0.7", names=("robots.example",), url="https://door.example/mcp")
    assert options.knows_host(host) is is_known
