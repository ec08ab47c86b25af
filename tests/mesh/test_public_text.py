"""What errors say outside the process: no URL beyond its host, no path of this machine, no secret."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from pathlib import Path
from typing import Any

import pytest

import bridges
import mesh
import schemas
from mesh.agent.jobs import note_of
from mesh.chain import NodeUnreachable
from mesh.errors import LONGEST_PUBLIC, AiraError, public_text
from mesh.telemetry.metrics import public_parts

KEY = "9aa3d95b3bc440fa88ea12eaa4456161"
URL = f"https://alice:{KEY}@mainnet.infura.io:8443/v3/{KEY}?apikey={KEY}#{KEY}"
FOLDER = "/home/alice/secret-folder"
SECRET = f"{URL} {FOLDER}/robot.json"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f"no node at {URL} (HTTP 503)", "no node at https://mainnet.infura.io:8443 (HTTP 503)"),
        (f"wss://node.example/{KEY}, http://127.0.0.1:8545", "wss://node.example, http://127.0.0.1:8545"),
        ("ws://[::1]:8546/abc", "ws://[::1]:8546"),
        (
            f"at http://127.0.0.1:5001: refused, see https://x.example/{KEY}.",
            "at http://127.0.0.1:5001: refused, see https://x.example.",
        ),
        ("file:///home/alice/key", "file://"),
        (f"can't write {FOLDER}/robot.json: no space left", "can't write …: no space left"),
        ("~/keys/robot.json is damaged", "… is damaged"),
        (r"C:\Users\alice\key.json is damaged", "… is damaged"),
        ("[Errno 2] No such file: '/root/a b'", "[Errno 2] No such file: '… b'"),
        ("no topic /lift/height", "no topic /lift/height"),
        ("12 m/s, and/or nothing", "12 m/s, and/or nothing"),
        ("costs at least 5 XRT", "costs at least 5 XRT"),
        ("\udcff", r"\udcff"),
    ],
)
def test_a_text_keeps_what_helps_and_loses_what_is_secret(text: str, shown: str) -> None:
    assert public_text(text) == shown


def test_a_text_is_bounded() -> None:
    assert len(public_text("x" * 10_000)) == LONGEST_PUBLIC


def every_error() -> list[type[BaseException]]:
    """Every class of an error that this project has."""
    for package in (schemas, mesh, bridges):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)

    def below(one: type[BaseException]) -> set[type[BaseException]]:
        return {one}.union(*(below(child) for child in one.__subclasses__()))

    ours = {one for one in below(Exception) if one.__module__.partition(".")[0] in ("schemas", "mesh", "bridges")}
    return sorted(ours, key=lambda one: f"{one.__module__}.{one.__qualname__}")


def made(kind: type[BaseException]) -> BaseException:
    """An error whose every argument that takes a text or a path has secrets in it."""
    arguments: list[Any] = []
    named: dict[str, Any] = {}
    for parameter in inspect.signature(kind).parameters.values():
        if (
            parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
            or parameter.default is not parameter.empty
        ):
            continue
        value = value_for(str(parameter.annotation))
        if parameter.kind is parameter.KEYWORD_ONLY:
            named[parameter.name] = value
        else:
            arguments.append(value)
    return kind(*arguments, **named)


def value_for(annotation: str) -> Any:
    """A value of that type; texts and paths are secret."""
    if "Path" in annotation:
        return Path(FOLDER) / "robot.json"
    if annotation.startswith(("int", "float")):
        return 7
    if annotation.startswith(("tuple", "list", "Sequence", "Iterable", "Collection")):
        return (SECRET,)
    if annotation.startswith("bytes"):
        return b"\1" * 32
    return SECRET


@pytest.mark.parametrize("kind", every_error(), ids=lambda kind: kind.__qualname__)
def test_no_error_tells_a_secret(kind: type[BaseException]) -> None:
    try:
        error = made(kind)
    except (TypeError, AttributeError, ValueError, KeyError):
        error = kind.__new__(kind)
        Exception.__init__(error, f"it failed: {SECRET}")
        error.__dict__.setdefault("hint", f"look at {SECRET}")
    for text in (public_text(error), public_text(getattr(error, "hint", ""))):
        assert KEY not in text
        assert "secret-folder" not in text
        assert "\n" not in text.strip()


def test_a_relative_path_in_a_field_is_hidden() -> None:
    class KeyDamaged(AiraError, code="key-damaged-in-a-test"):
        def __init__(self, path: Path) -> None:
            super().__init__(f"{path} is damaged")
            self.path = path

    assert public_text(KeyDamaged(Path("keys/alice.json"))) == "… is damaged"


def test_notes_and_parts_tell_no_secret() -> None:
    node = NodeUnreachable(URL, "HTTP 503")
    assert note_of(node) == "no Ethereum node answers at https://mainnet.infura.io:8443 (HTTP 503) [node-unreachable]"
    assert (
        note_of(RuntimeError(f"asked {URL}")) == "RuntimeError: asked https://mainnet.infura.io:8443 [handler-failed]"
    )
    assert public_parts({"chain": str(node)})["chain"].startswith(
        "no Ethereum node answers at https://mainnet.infura.io:8443"
    )
