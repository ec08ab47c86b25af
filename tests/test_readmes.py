"""The commands of the READMEs and of the tutorial, run as printed by shells that have nothing but a PATH and a home.

What the pages show of their output is what they print, but for addresses, hashes and numbers.

The ports are this test's own, by variables; `aira up` has none for its chain, so that gets options.
"""

from __future__ import annotations

import re
import shutil
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from documentation.blocks import blocks as blocks_of
from tests.support.commands import Serving, run
from tests.support.peers import require
from tests.support.ports import free_port

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator, Sequence

ROOT: Final = Path(__file__).parents[1]
TUTORIAL: Final = ROOT / "docs" / "tutorials" / "first-robot.md"
READMES: Final = (ROOT / "README.md", *sorted(ROOT.glob("examples/*/README.md")))
COMMAND: Final = re.compile(r"(?:\w+=\S+ )*(?:aira|echo|eval|export|make|npm|pip|pipx|python|uv)\s")
PORT: Final = "/tmp/aira-board-…/tty"
"""What readers replace by the port that `aira board run` has printed."""

SERVES: Final = {
    "aira up": "export AIRA_KEYFILE_PASSWORD_FILE",
    "aira router": "listens at",
    "aira board run": "connect it with",
    "aira edge": "edge of 0x",
    "hello_mesh/agent.py": "watching on",
    "/robot.py": "account 0x",
    "/rover.py": "the rover drives",
}
"""Commands that serve until they are stopped, each with what it prints when it is ready."""
VARIES: Final = re.compile(r"0x[0-9a-fA-F]+|Qm\w{44}|\b[0-9a-f]{64}\b|\d[\d,.]*")
"""What commands print, and is another each time."""
NOT_RUN: Final = {
    "aira chain deploy": "it is for other chains than that of `aira up`, which has the contracts",
    "make test": "it runs this test",
    "pipx install": "it installs from a registry; the tests of the wheel install the package",
}
ENDS: Final = {
    "aira demand": "paid, result Qm",
    "person.py": "hydrogen",
    "client.py": "Alice was paid",
    "objective show": "/patrol/goal",
    "plot.py": "measurements",
    "completion": "",
    "model check": "the objective fits",
}
"""What commands print that have done their work."""


def blocks(readme: Path) -> list[str]:
    """The commands of a README, one text for each of its blocks."""
    found = re.findall(r"(?:^    .*\n|^\n(?=    ))+", readme.read_text(encoding="utf-8"), re.MULTILINE)
    return [
        block
        for text in found
        for block in re.split(r"\n\n+", re.sub(r"^    ", "", text, flags=re.MULTILINE).strip("\n"))
        if COMMAND.match(block)
    ]


def lines_of(text: str) -> list[str]:
    """The lines of an output, as they are each time; lines about progress, which are alike then, once."""
    lines = [VARIES.sub("…", " ".join(line.split())) for line in text.splitlines() if line.strip()]
    lines = [line for line in lines if not line.startswith("$ ")]  # on a page, what was typed
    return [line for line, before in zip(lines, ["", *lines], strict=False) if line != before]


def blocks_printed(page: Path, printed: str) -> int:
    """How many blocks of a page show what a command has printed: their first line is in it, and so must be the rest."""
    output, found = lines_of(printed), 0
    for block in blocks_of(page):
        shown = lines_of(block.text)
        if shown and shown[0] in output:
            at = output.index(shown[0])
            assert output[at : at + len(shown)] == shown, f"{page.name}:{block.line}"
            found += 1
    return found


@dataclass
class Reader:
    """Somebody who types the commands of a README, each block into a shell of its own, in a clone."""

    clone: Path
    variables: dict[str, str]
    chain: int
    stack: ExitStack
    port: str = PORT

    def follow(self, commands: Sequence[str]) -> list[str]:
        """Run all blocks; what those printed that end."""
        return [printed for block in commands for printed in self.type(block)]

    def type(self, block: str) -> Iterator[str]:
        """Run the commands of a block, but for those that can't be run here."""
        lines = block.replace("\\\n", "").replace(PORT, self.port).splitlines()
        lines = [line for line in lines if not any(line.startswith(command) for command in NOT_RUN)]
        if not lines:
            return
        says = next((says for part, says in SERVES.items() if part in lines[-1]), None)
        if says is None:
            done = self._run("\n".join(lines))
            assert done.returncode == 0, f"{block}\n{done.stdout}{done.stderr}"
            for command, printed in ENDS.items():
                assert command not in block or printed in done.stdout, f"{block}\n{done.stdout}{done.stderr}"
            yield done.stdout
            return
        if lines[-1].startswith("aira up"):
            lines[-1] += f" --engine embedded --port {self.chain} --no-web"
        lines[-1] = re.sub(r"^((?:\w+=\S+ )*)", r"\1exec ", lines[-1])  # so that it is the process that is stopped
        server = self.stack.enter_context(Serving(*self._shell("\n".join(lines)), says=says))
        if found := re.search(r"connect it with: aira edge (\S+)", server.log()):
            self.port = found[1]

    def _run(self, script: str) -> subprocess.CompletedProcess[str]:
        return run(*self._shell(script))

    def _shell(self, script: str) -> tuple[str, ...]:
        variables = (f"{name}={value}" for name, value in self.variables.items())
        return ("env", "-i", *variables, "bash", "-euo", "pipefail", "-c", f"cd {self.clone}\n{script}")


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    clone, temporary = tmp_path / "clone", tmp_path / "t"
    temporary.mkdir()
    shutil.copytree(ROOT / "examples", clone / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    # What the commands write stays in this clone; the packages are installed.
    router, chain, ros = (free_port() for _ in range(3))
    variables = {
        "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
        "HOME": str(tmp_path),
        "TMPDIR": str(temporary),
        "AIRA_LISTEN": f"tcp/127.0.0.1:{router}",
        "AIRA_CONNECT": f"tcp/127.0.0.1:{router}",
        "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{chain}",
        "ROS2_CONNECT": f"tcp/127.0.0.1:{ros}",
    }
    with ExitStack() as stack:
        yield Reader(clone, variables, chain, stack)


def board_tools() -> None:
    for tool in ("avr-gcc", "arduino-core", "libsimavr"):
        require(tool)


def like_blink(example: str, **names: str) -> list[str]:
    """The commands of blink, with another folder's files, as the READMEs of the others say."""
    assert "Run it like" in (ROOT / f"examples/{example}/README.md").read_text(encoding="utf-8")
    text = "\0".join(blocks(ROOT / "examples/blink/README.md")[1:])  # the first one makes its objective
    for name, other in names.items():
        text = text.replace(name, other)
    return text.replace("examples/blink/", f"examples/{example}/").split("\0")


def test_no_readme_is_forgotten() -> None:
    counts = {str(readme.parent.relative_to(ROOT)): len(blocks(readme)) for readme in READMES}
    assert counts == {
        ".": 3,
        "examples/air_pollution": 3,
        "examples/blink": 6,
        "examples/blink_arguments": 1,
        "examples/firmware": 4,
        "examples/forklift": 4,
        "examples/ros2_patrol": 4,
        "examples/rover": 3,
    }


def test_the_first_steps(reader: Reader) -> None:
    # `make demo` sets up an environment, which is there, and then runs this.
    commands = [re.sub(r"^make demo", "aira demo", block) for block in blocks(ROOT / "README.md")]
    (demo, _) = reader.follow(commands)
    assert "person    had 1,000 XRT, has 958 XRT" in demo
    assert blocks_printed(ROOT / "README.md", demo) == 3


def test_the_tutorial(reader: Reader) -> None:
    written = blocks(TUTORIAL)
    market = [block for block in written if "aira up --data-dir" in block or "examples/hello_mesh" in block]
    (printed,) = reader.follow(market)
    assert blocks_printed(TUTORIAL, printed) == 1
    (contract,) = re.findall(r"^contract (0x\w{40})", printed, re.MULTILINE)
    (questions,) = [block for block in written if block.startswith("aira chain status")]
    account = f"{market[-1].splitlines()[0]} AIRA_KEYFILE=.aira/development/person.json\n"
    (answers,) = reader.follow([account + re.sub(r"0x\w{40}", contract, questions)])
    assert "958 XRT" in answers


def test_a_job_is_ordered_of_the_rover(reader: Reader) -> None:
    reader.variables |= {"AIRA_NAME": "Rover 1", "AIRA_PLACE": "Hall 3"}
    (printed,) = reader.follow(blocks(ROOT / "examples/rover/README.md"))
    assert "paid, result Qm" in printed
    (robots,) = reader.follow(["aira robots"])
    assert blocks_printed(ROOT / "docs/guides/publishing.md", robots) == 1


def test_the_other_forklift_does_what_the_cheaper_one_gives_up(reader: Reader) -> None:
    readme = ROOT / "examples/forklift/README.md"
    (printed,) = reader.follow(blocks(readme))
    (shown,) = re.findall(r"It prints:\n\n((?:    .*\n)+)", readme.read_text(encoding="utf-8"))
    assert printed.splitlines() == [line.strip() for line in shown.splitlines()]


@pytest.mark.full
def test_a_robot_with_ros_2_patrols(reader: Reader) -> None:
    reader.follow(blocks(ROOT / "examples/ros2_patrol/README.md"))
    assert (reader.clone / "result.mcap").exists()


def test_the_lamp_blinks(reader: Reader) -> None:
    board_tools()
    reader.follow(blocks(ROOT / "examples/blink/README.md"))
    assert (reader.clone / "blink.mcap").read_bytes() == (ROOT / "examples/blink/blink.mcap").read_bytes()
    assert (reader.clone / "result.mcap").exists()


@pytest.mark.full
def test_the_lamp_of_the_colour_blinks(reader: Reader) -> None:
    board_tools()
    reader.follow(blocks(ROOT / "examples/blink_arguments/README.md"))
    reader.follow(like_blink("blink_arguments", blink_frames="colours_frames", **{"blink.mcap": "red.mcap"}))
    assert (reader.clone / "result.mcap").exists()


@pytest.mark.full
def test_the_air_is_measured(reader: Reader) -> None:
    board_tools()
    own = blocks(ROOT / "examples/air_pollution/README.md")
    assert "--times 20" in own[1]
    assert "--seconds 60 --out air.mcap" in own[2].replace("\\\n        ", "")
    own[1] = own[1].replace("--times 20", "--times 2")  # a test has less time than a reader
    own[2] = own[2].replace("--seconds 60 --out air.mcap", "--seconds 3 --out heard.mcap")
    reader.follow([*like_blink("air_pollution", blink_frames="air_frames")[:-1], *own])
    assert (reader.clone / "air.png").read_bytes().startswith(b"\x89PNG")
    assert (reader.clone / "heard.mcap").exists()


def test_a_board_is_connected(reader: Reader) -> None:
    board_tools()
    reader.follow(blocks(ROOT / "examples/firmware/README.md"))
    assert reader.port != PORT
