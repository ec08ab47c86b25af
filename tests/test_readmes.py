"""The commands of the READMEs, and of the guide to the command line, run as printed in a clone.

What the pages show of their output is what they print, but for addresses, hashes and numbers.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from tests.support.peers import require
from tests.support.reader import PORT, Reader, blocks, blocks_printed, reading

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT: Final = Path(__file__).parents[1]
GUIDE: Final = ROOT / "docs" / "guides" / "command-line.md"
READMES: Final = (ROOT / "README.md", *sorted(ROOT.glob("examples/*/README.md")))


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    # What the commands write stays in this clone; the packages are installed.
    examples = tmp_path / "clone" / "examples"
    shutil.copytree(ROOT / "examples", examples, ignore=shutil.ignore_patterns("__pycache__"))
    with reading(examples.parent) as one:
        yield one


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


def test_the_guide_to_the_command_line(reader: Reader) -> None:
    written = blocks(GUIDE)
    market = [block for block in written if "aira up --data-dir" in block or "examples/hello_mesh" in block]
    (printed,) = reader.follow(market)
    assert blocks_printed(GUIDE, printed) == 1
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
    assert (reader.folder / "result.mcap").exists()


def test_the_lamp_blinks(reader: Reader) -> None:
    board_tools()
    reader.follow(blocks(ROOT / "examples/blink/README.md"))
    assert (reader.folder / "blink.mcap").read_bytes() == (ROOT / "examples/blink/blink.mcap").read_bytes()
    assert (reader.folder / "result.mcap").exists()


@pytest.mark.full
def test_the_lamp_of_the_colour_blinks(reader: Reader) -> None:
    board_tools()
    reader.follow(blocks(ROOT / "examples/blink_arguments/README.md"))
    reader.follow(like_blink("blink_arguments", blink_frames="colours_frames", **{"blink.mcap": "red.mcap"}))
    assert (reader.folder / "result.mcap").exists()


@pytest.mark.full
def test_the_air_is_measured(reader: Reader) -> None:
    board_tools()
    own = blocks(ROOT / "examples/air_pollution/README.md")
    assert "--times 20" in own[1]
    assert "--seconds 60 --out air.mcap" in own[2].replace("\\\n        ", "")
    own[1] = own[1].replace("--times 20", "--times 2")  # a test has less time than a reader
    own[2] = own[2].replace("--seconds 60 --out air.mcap", "--seconds 3 --out heard.mcap")
    reader.follow([*like_blink("air_pollution", blink_frames="air_frames")[:-1], *own])
    assert (reader.folder / "air.png").read_bytes().startswith(b"\x89PNG")
    assert (reader.folder / "heard.mcap").exists()


def test_a_board_is_connected(reader: Reader) -> None:
    board_tools()
    reader.follow(blocks(ROOT / "examples/firmware/README.md"))
    assert reader.port != PORT
