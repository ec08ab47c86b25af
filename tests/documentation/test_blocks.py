"""Each block of code or commands in the pages is run, or it is said why it is not.

Python runs here, in a market, and settings are loaded. Every command is held against the definitions of `aira`, of the
Makefile and of the files that are there, so that no page shows a flag that does not exist; that it does what the page
says is what the tests named in `RUN` show, or cannot be shown here for the reason in `NOT_RUN`. A block of Python that
can't be run has the reason in a comment before it, which the site does not show: `<!-- not run: it needs … -->`.
"""

from __future__ import annotations

import ast
import asyncio
import inspect
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any, Final
from unittest.mock import AsyncMock, MagicMock

import pytest

import mesh
from mesh import Agent, Job, cid_of_file
from mesh.settings import OPTIONS, load
from mesh.testing import FakeJob, Market, assert_paid, run
from tests.support.blocks import Block, blocks
from tests.support.documentation.commands import commands, scripts, wrong_words

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = {
    str(page.relative_to(ROOT)): page
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted(ROOT.glob("docs/**/*.md")))
}
BLOCKS: Final = {f"{name}:{block.line}": block for name, page in PAGES.items() for block in blocks(page)}

RUN: Final = {
    "README.md": "tests/test_readmes.py",
    "docs/guides/devices.md": "tests/bridges/serial/test_own_sketch.py",
    "docs/guides/describe-a-robot.md": "tests/mesh/cli/test_model.py",
    "docs/guides/owners.md": "tests/mesh/cli/test_owners_page.py",
    "docs/guides/testing.md": "tests/mesh/testing/test_page.py",
    "docs/guides/testing-market.md": "tests/mesh/testing/test_page.py",
    "docs/tutorials/first-device.md": "tests/test_tutorials.py",
    "docs/tutorials/first-robot.md": "tests/test_tutorials.py",
    "docs/tutorials/first-site.md": "tests/test_tutorials.py",
}
"""Pages whose programs and commands a test of their own runs."""
NOT_RUN: Final = {
    "aira-as": "it is installed as root, with systemd; deploy/systemd has it",
    "chmod": "it is the system's",
    "cp": "it is the system's",
    "curl": "it asks a server that is installed as root",
    "docker": "`make compose-test` runs the compose files",
    "git": "it asks another host",
    "journalctl": "it needs systemd",
    "mkdir": "it is the system's",
    "npm": "it asks a registry",
    "npx": "it runs what npm fetched",
    "openssl": "it is the system's",
    "pip": "it asks a registry; the tests of the wheel install the package",
    "pipx": "it asks a registry; the tests of the wheel install the package",
    "pytest": "it would run this test",
    "python3": "it makes an environment, as `make setup` does",
    "rm": "it is the system's",
    "ros2": "it needs ROS 2; tests/bridges/ros2 runs peers that speak the same",
    "sed": "it is the system's",
    "sh": "it runs a script of the page; tests/test_tutorials.py runs that",
    "systemctl": "it needs systemd",
    "umask": "it is the shell's",
}
"""Programs other than the project's, each with the reason why the tests do not run what the pages show of them."""
SHELL: Final = frozenset({"cd", "echo", "eval", "export", "printf", "source"})
OWN: Final = frozenset({"aira", "make", "python"})
LISTED: Final = re.compile(r"^(?:# \S+\.toml|\w+ = )")
CODE: Final = re.compile(r"^(?:from \w|import \w|async |await |@\w|class \w+[:(]|def \w|[A-Z_]+ = \w+\()")


def kind(block: Block) -> str:
    """What a block holds: `python`, `toml`, `json`, `cpp`, `commands`, or `text`, which is drawn or printed."""
    if block.language:
        return block.language
    if LISTED.match(block.text):
        return "toml"
    first = re.sub(r"^(?:\$ )?(?:\w+=\S+ )*", "", block.text).split(None, 1)[0]
    program = first.rpartition("/")[2]
    is_command = block.text.startswith("$ ") or program in NOT_RUN or program in SHELL or program in OWN
    return "commands" if is_command or (ROOT / first).is_file() else "text"


def is_code(block: Block) -> bool:
    return bool(CODE.match(block.text)) and block.note[0] != "not run"


def of(*kinds: str) -> list[Any]:
    return [pytest.param(block, id=name) for name, block in BLOCKS.items() if kind(block) in kinds]


def test_no_program_is_taken_for_something_that_is_printed() -> None:
    texts = [name for name, block in BLOCKS.items() if kind(block) == "text" and is_code(block)]
    assert texts == []
    assert {kind(block) for block in BLOCKS.values()} <= {
        "bash",
        "commands",
        "cpp",
        "json",
        "python",
        "sh",
        "text",
        "toml",
    }


def test_the_tests_that_run_pages_exist() -> None:
    assert [name for name, test in RUN.items() if name not in PAGES or not (ROOT / test).is_file()] == []


@pytest.mark.parametrize("block", of("commands", "bash"))
def test_commands_are_those_that_exist(block: Block, tmp_path: Path) -> None:
    script = scripts(block.text)
    (tmp_path / "script").write_text(script)
    checked = subprocess.run(["bash", "-n", tmp_path / "script"], capture_output=True, text=True, check=False)
    assert checked.stderr == ""
    assert [problem for command in commands(script) if (problem := wrong(command))] == []


def wrong(command: list[str]) -> str:
    program, *words = command
    name = program.rpartition("/")[2]
    match name:
        case "aira":
            return wrong_words(words)
        case "aira-as":
            return wrong_words(words[1:])
        case "make":
            targets = re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), re.MULTILINE)
            return "".join(f"no target {word}" for word in words if "=" not in word and word not in targets)
        case "python" if words[0] != "-m" and words[0].startswith("examples/"):
            return "" if (ROOT / words[0]).is_file() else f"no file {words[0]}"
        case "python" if words[0] == "-m":
            module = ROOT / words[1].replace(".", "/")
            return "" if module.is_dir() or module.with_suffix(".py").is_file() else f"no module {words[1]}"
    known = name in SHELL or name in NOT_RUN or name in OWN or (ROOT / program).is_file()
    return "" if known else f"neither a program of the project nor one in NOT_RUN: {program}"


@pytest.mark.parametrize("block", of("toml"))
def test_settings_are_accepted(block: Block, tmp_path: Path) -> None:
    written = tomllib.loads(block.text)
    assert written
    if written.keys() & set(OPTIONS):
        (tmp_path / "settings.toml").write_text(block.text)
        load(path=tmp_path / "settings.toml", environ={})


def test_what_is_not_python_is_tried_by_another_test() -> None:
    other = {block.page.relative_to(ROOT).as_posix() for block in BLOCKS.values() if kind(block) in ("cpp", "json")}
    # tests/mesh/cli/test_model.py reads the example of one, tests/bridges/mcp/test_mcp_command.py those of the other.
    assert other <= {*RUN, "docs/reference/models.md", "docs/guides/mcp.md"}


MODEL: Final = cid_of_file(ROOT / "examples/hello_mesh/model.md")
JOBS: Final[dict[str, tuple[str, Any]]] = {"README.md": ("/blink", None), "docs/guides/agents.md": ("/say", "hello")}
"""Pages whose program is a whole robot, with a message that it handles."""
PROGRAMS: Final = {
    name: [block for block in BLOCKS.values() if block.page == page and kind(block) == "python"]
    for name, page in PAGES.items()
    if name not in RUN or name == "README.md"
}


@pytest.mark.parametrize("name", [name for name, found in PROGRAMS.items() if found])
async def test_programs_run(name: str, market: Market, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Agent, "run", lambda agent: None)  # a program's last line; its handlers get a job instead
    for objective in ("blink.mcap", "lift.mcap"):
        shutil.copy(ROOT / "examples/hello_mesh/blink.mcap", objective)
    async with market.robot(working()) as robot, market.robot(Agent(MODEL)) as person:
        names = {**public_names(), **stand_ins(), "model": MODEL}
        for block in PROGRAMS[name]:
            code = runnable(block, robot.address)
            if block.note[0] == "not run":
                continue
            if is_asynchronous := bool(code.co_flags & inspect.CO_COROUTINE):
                names["agent"] = person
            async with asyncio.timeout(30):
                result = eval(code, names)
                if is_asynchronous:
                    await result
    if name in JOBS:
        assert_paid(await run(names["agent"], FakeJob([JOBS[name]])))


def runnable(block: Block, address: str) -> Any:
    """A block as code that may await; what stands for an address or a CID is one."""
    text = block.text.replace('"0x…"', f'"{address}"').replace('"Qm…"', f'"{MODEL}"')
    flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
    return compile(text, f"{block.page.name}:{block.line}", "exec", flags=flags, dont_inherit=True)


def working() -> Agent:
    """A robot that does whatever is ordered."""
    robot = Agent(MODEL)
    robot.on("*")(lambda job, message: job.publish("/done", 1.0))
    robot.on_demand(robot.offer)
    robot.on_quote(lambda request: "5 XRT")
    return robot


def public_names() -> dict[str, Any]:
    return {name: getattr(mesh, name) for name in vars(mesh)["__all__"]}


def stand_ins() -> dict[str, Any]:
    """What the fragments on the pages speak of and do not define."""
    agent = Agent()
    return {
        "__name__": "page",
        "agent": agent,
        "robot": agent,
        "job": MagicMock(spec=Job),
        "jpeg": b"\xff\xd8\xff",
        "mine": (),
        "Move": float,
        "my_lamp": AsyncMock(),
        "tool": MagicMock(),
    }
