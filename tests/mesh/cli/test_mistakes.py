"""Mistakes that people make at the command line: each ends at once, in one line with a code, without a traceback."""

from __future__ import annotations

import os
import socket
from contextlib import closing
from typing import TYPE_CHECKING, Final, NamedTuple

import pytest

from schemas import cid_of_bytes
from tests.support.commands import aira, invoke
from tests.support.objectives import objective
from tests.support.orders import LIGHTHOUSE
from tests.support.ports import free_port
from tests.support.waiting import at_most

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator
    from pathlib import Path

SECONDS: Final = 20.0
"""What a mistake may take on a busy machine; alone it takes less than two."""
CID: Final = cid_of_bytes(b"a model")
LONG: Final = "x" * 5000
DEEP: Final = "[" * 5000
NODE: Final = "no-node"
"""Words of commands that stand for a port: nobody listens at one, somebody at the other."""
TAKEN: Final = "taken"


class Mistake(NamedTuple):
    """A command line, the code of its error, and what its line or hint says. Exits with 2, unless said otherwise."""

    words: str
    code: str
    says: str
    exit_code: int = 2


MISTAKES: Final = (
    # what does not exist
    Mistake("objectiv", "invalid-usage", "did you mean 'objective'?"),
    Mistake("xyzzy", "invalid-usage", "aira --help"),
    Mistake("objective sho", "invalid-usage", "did you mean 'show'?"),
    Mistake("demand --keyfle x", "invalid-usage", "--keyfile"),
    Mistake("--verbose", "invalid-usage", "--verbose"),
    Mistake(f"rpc {LIGHTHOUSE} nosuch", "unknown-service", "--list"),
    Mistake(f"rpc {LIGHTHOUSE} strat", "unknown-service", "did you mean start?"),
    Mistake(f"rpc {LIGHTHOUSE} read adress=x", "invalid-argument", "did you mean address?"),
    Mistake("rpc start 0x1", "invalid-address", "'start'"),
    Mistake(f"rpc {LIGHTHOUSE}", "invalid-usage", "--list"),
    Mistake("completion tcsh", "invalid-usage", "'tcsh'"),
    # what is missing
    Mistake(f"demand --model {CID}", "invalid-options", "--objective"),
    Mistake("demand --objective objective.mcap", "invalid-options", "--robot"),
    Mistake("demand --robot lift --message go", "invalid-line", "'go'"),
    Mistake("cid", "invalid-usage", "FILES"),
    Mistake("router config", "invalid-usage", "--out"),
    Mistake("router acl", "roster-missing", "--roster"),
    Mistake("objective pack --out new.mcap", "invalid-options", "--hear"),
    Mistake("verify", "invalid-options", "--objective"),
    Mistake("health", "invalid-server-address", "--url"),
    Mistake("lighthouse join here", "invalid-options", "VALUE"),
    Mistake("order withdraw", "invalid-usage", "--all"),
    Mistake("order withdraw ab --all", "invalid-usage", "--all"),
    Mistake(f"demand --model {CID} --objective objective.mcap", "account-not-set", "--keyfile"),
    Mistake("rpc", "invalid-usage", "ADDRESS"),
    Mistake("order list", "account-missing", "--keyfile"),
    Mistake("replay objective.mcap --to lamp", "account-missing", "--keyfile"),
    # values that can't be right
    Mistake("demand --model lamp --objective objective.mcap", "not-a-model", "file"),
    Mistake(f"demand --model {CID} --objective objective.mcap --cost much", "invalid-amount", "--cost"),
    Mistake(f"demand --model {CID} --objective objective.mcap --validator me", "invalid-address", "'me'"),
    Mistake(f"demand --model {'x' * 300} --objective objective.mcap", "not-a-model", "file"),
    Mistake("watch --model lamp", "not-a-model", "'lamp'"),
    Mistake("status 0x12", "invalid-address", "'0x12'"),
    Mistake("logs nobody", "invalid-address", "'nobody'"),
    Mistake(f"logs {LIGHTHOUSE} --level loud", "invalid-usage", "'warning'"),
    Mistake("liability show nothing", "invalid-address", "'nothing'"),
    Mistake("liability cancel nothing", "invalid-address", "'nothing'"),
    Mistake("liability list --state odd", "invalid-usage", "'finalized'"),
    Mistake("verify nothing", "invalid-address", "'nothing'"),
    Mistake("xrt transfer you 1", "invalid-address", "'you'"),
    Mistake(f"xrt transfer {LIGHTHOUSE} much", "invalid-amount", "1.5"),
    Mistake("xrt balance --token 0xgold", "invalid-address", "'0xgold'"),
    Mistake("lighthouse create a_b", "invalid-lighthouse", "'a_b'"),
    Mistake("edge /dev/null --agent nobody", "invalid-key", "'nobody'"),
    Mistake("chain up --port 99999", "invalid-usage", "99999"),
    Mistake("identity new folder --site site --name x --role robot", "invalid-usage", "'agent'"),
    Mistake("doctor --role robot", "invalid-usage", "'agent'"),
    # files
    Mistake("objective show missing.mcap", "not-a-file-or-cid", "missing.mcap"),
    Mistake("objective show model.md", "not-a-recording", "model.md"),
    Mistake("objective show cut.mcap", "corrupt-recording", "recover"),
    Mistake("objective add model.md --keyfile keyfile.json", "objective-unfit", "not-a-recording"),
    Mistake("objective add objective.mcap --objective-size-limit 10", "objective-unfit", "objective_size_limit"),
    Mistake(
        "objective add objective.mcap --objective-expanded-limit 10", "objective-unfit", "objective_expanded_limit"
    ),
    Mistake("objective convert objective.mcap", "file-exists", "objective.mcap"),
    Mistake("objective pack model.md --out new.mcap", "invalid-line", '{"topic"'),
    Mistake("objective get lamp --out new.mcap", "invalid-cid", "'lamp'"),
    Mistake("objective pack --hear a//b --out new.mcap", "invalid-destination", "'a//b'"),
    Mistake("cid missing", "file-unreadable", "missing"),
    Mistake("state restore model.md", "archive-unusable", "model.md"),
    Mistake("identity show folder", "identity-unusable", "aira identity new"),
    Mistake("board run model.md", "invalid-firmware", "model.md"),
    # accounts and settings
    Mistake("account show missing.json", "keyfile-error", "aira account new"),
    Mistake("account new keyfile.json --password-file password", "file-exists", "keyfile.json"),
    Mistake("provider --keyfile unversioned.json --keyfile-password-file password", "not-a-keyfile", "no version"),
    Mistake(f"chain status --web3-http-provider {LIGHTHOUSE}", "invalid-endpoint", "http://"),
    Mistake("chain status --generation 4", "invalid-option", "generation"),
    Mistake("chain status --config not.toml", "settings-not-toml", "not.toml"),
    Mistake("chain status --config unknown.toml", "unknown-option", "zebra"),
    Mistake("chain deploy", "account-not-set", "aira account new"),
    *(
        Mistake(words, "file-unusable", "name too long")
        for words in (
            f"objective show {LONG}",
            f"objective check {LONG}",
            f"objective convert {LONG} {LONG}",
            f"objective pack lines.jsonl --out {LONG}",
            f"model check {LONG}",
            f"replay {LONG}",
            f"state show --data-dir {LONG}",
        )
    ),
    *(
        Mistake(words, code, "nested more than")
        for words, code in (
            ("settings --config deep.toml", "settings-not-toml"),
            ("model check deep.json", "invalid-description"),
            ("objective pack deep.jsonl --out new.mcap", "invalid-line"),
            (f'rpc {LIGHTHOUSE} status {{"a":{DEEP}', "invalid-argument"),
        )
    ),
    # other machines and programs
    Mistake(f"chain status --web3-http-provider http://127.0.0.1:{NODE}", "node-unreachable", "aira chain up", 1),
    Mistake(f"chain up --engine embedded --port {TAKEN}", "port-unavailable", "--port"),
    Mistake(f"up --engine embedded --listen tcp/127.0.0.1:{NODE} --port {TAKEN}", "port-unavailable", "--port"),
    Mistake(f"router --listen tcp/127.0.0.1:{TAKEN}", "listen-failed", "--listen"),
    Mistake(f"router --listen tcp/127.0.0.1:{NODE} --metrics-listen 127.0.0.1:{TAKEN}", "metrics-not-served", "--met"),
    Mistake("router --listen tcp/0.0.0.0:7447", "configuration-error", "--roster"),
    Mistake(f"peers --connect-timeout 0.1 --connect tcp/127.0.0.1:{NODE}", "network-unavailable", "aira router", 1),
    Mistake("peers --connect localhost", "configuration-error", "tcp/HOST:PORT"),
    Mistake("bridge ipfs --api localhost", "configuration-error", "/ip4/"),
    Mistake("up --engine embedded --state chain.json", "anvil-missing", "--state"),
)
SEVERAL: Final = 6
"""Every so many of them also run as a process."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with files to take for others."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "model.md").write_text("A lamp.\n")
    (tmp_path / "objective.mcap").write_bytes(objective(("/go", "there")))
    (tmp_path / "cut.mcap").write_bytes(objective(("/go", "there"))[:-20])
    (tmp_path / "password").write_text("secret\n")
    (tmp_path / "keyfile.json").write_text(f'{{"version": 3, "address": "{LIGHTHOUSE[2:].lower()}", "crypto": {{}}}}')
    (tmp_path / "unversioned.json").write_text('{"crypto": {}}')
    (tmp_path / "not.toml").write_text("keyfile =\n")
    (tmp_path / "deep.toml").write_text(f"keyfile = {DEEP}\n")
    (tmp_path / "deep.json").write_text(DEEP)
    (tmp_path / "deep.jsonl").write_text(f'{{"topic":"/a","value":{DEEP}\n')
    (tmp_path / "lines.jsonl").write_text('{"topic":"/a","value":1}\n')
    (tmp_path / "unknown.toml").write_text("zebra = 1\n")
    return tmp_path


@pytest.fixture
def ports() -> Iterator[dict[str, str]]:
    """A port that is free, and one that is taken."""
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        yield {TAKEN: str(taken.getsockname()[1]), NODE: str(free_port())}


def words_of(mistake: Mistake, ports: dict[str, str]) -> list[str]:
    words = mistake.words.split(" ")
    return [word.replace(TAKEN, ports[TAKEN]).replace(NODE, ports[NODE]) for word in words]


def check(done: subprocess.CompletedProcess[str], mistake: Mistake) -> None:
    lines = done.stderr.splitlines()
    assert "Traceback" not in done.stderr
    assert done.returncode == mistake.exit_code, done.stderr
    said = [line for line in lines if line.startswith("aira: ")]
    assert len(said) == 1, done.stderr
    assert said[0].endswith(f" [{mistake.code}]"), done.stderr
    assert len(lines) - lines.index(said[0]) <= 2, "at most a hint follows"
    assert mistake.says in done.stderr


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.words[:60])
def test_a_mistake_is_one_line_with_a_code(mistake: Mistake, ports: dict[str, str]) -> None:
    with at_most(SECONDS):
        check(invoke(*words_of(mistake, ports), AIRA_DATA_DIR="data"), mistake)


@pytest.mark.parametrize("mistake", MISTAKES[::SEVERAL], ids=lambda mistake: mistake.words[:60])
def test_a_mistake_is_one_line_of_a_process(mistake: Mistake, ports: dict[str, str], folder: Path) -> None:
    check(aira(*words_of(mistake, ports), AIRA_DATA_DIR=str(folder / "data"), PATH=os.environ["PATH"]), mistake)
