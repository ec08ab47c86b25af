"""The tutorials, followed as printed from an empty folder: their commands, what is clicked, and what is seen."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from tests.support.peers import require
from tests.support.ports import free_port
from tests.support.reader import blocks, reading
from tests.support.waiting import wait_until
from tests.support.web.browser import Browser

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.reader import Reader

TUTORIALS: Final = Path(__file__).parents[1] / "docs" / "tutorials"


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    with reading(tmp_path / "empty") as one:
        one.page = "--web-port 0"
        yield one


def order(tutorial: str, reader: Reader, tmp_path: Path) -> str:
    """Do on the page what the numbered steps of a tutorial say, until the robot is paid; what the page then shows."""
    (url,) = re.findall(r"^page +(\S+)", reader.market, re.MULTILINE)
    steps = " ".join(re.findall(r"^\d\. (.*)", (TUTORIALS / tutorial).read_text(encoding="utf-8"), re.MULTILINE))
    with Browser(url) as browser:
        browser.go()
        for number, label in re.findall(r"(?:Write (\d+) under )?\*([^*]+)\*", steps):
            browser.type(label, number) if number else browser.press(label)
        browser.sees("The work is done, and the robot was paid.")
        browser.sees("All messages")
        browser.until(lambda: "Loading" not in browser.text(), "the recording")
        folder = Path(os.environ.get("PAGE_PICTURES") or tmp_path)
        browser.picture(folder / f"{tutorial.removesuffix('.md')}.png")
        return browser.text()


def test_the_first_robot_is_paid(reader: Reader, tmp_path: Path) -> None:
    require("chromium")
    up, test = blocks(TUTORIALS / "first-robot.md")
    reader.follow([up])
    assert "Times\n3" in order("first-robot.md", reader, tmp_path)
    reader.follow([test])


def test_the_first_device_shines(reader: Reader, tmp_path: Path) -> None:
    for tool in ("avr-gcc", "arduino-core", "libsimavr", "chromium"):
        require(tool)
    text = (TUTORIALS / "first-device.md").read_text(encoding="utf-8")
    reader.follow(blocks(TUTORIALS / "first-device.md"))
    (shown,) = re.findall(r"```cpp\n(.*?)```", text, re.DOTALL)
    sketch = (reader.folder / "lamp" / "board" / "board.ino").read_text(encoding="utf-8")
    assert all(line in sketch.splitlines() for line in shown.splitlines())
    assert "Dim answer\n/dim/answer\n64" in order("first-device.md", reader, tmp_path)


def test_the_first_site_is_closed(reader: Reader) -> None:
    page = TUTORIALS / "first-site.md"
    router, chain = f"127.0.0.1:{free_port()}", f"127.0.0.1:{reader.chain}"
    (script,) = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)

    def here(text: str) -> str:
        return text.replace("127.0.0.1:7447", router).replace("127.0.0.1:8545", chain)

    for name in ("AIRA_LISTEN", "AIRA_CONNECT", "AIRA_WEB3_HTTP_PROVIDER"):
        del reader.variables[name]  # the page says them
    (reader.folder / "as").write_text(here(script))
    *members, stranger, revoked, person = map(here, blocks(page))
    printed = reader.follow(members)
    assert any("paid, result Qm" in one for one in printed)
    refusals = re.findall(r"^    (aira: .*)", here(page.read_text(encoding="utf-8")), re.MULTILINE)
    assert refusals[0] in reader.refused(stranger)
    reader.follow([revoked])
    wait_until(lambda: refusals[1] in reader.refused(person), what="the refusal of the revoked member")
