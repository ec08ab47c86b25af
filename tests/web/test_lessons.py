"""The lessons of the legacy network, ordered from the page: real firmware on a simulated Uno does the work."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from eth_account import Account

from schemas import cid_of_file
from tests.support.commands import Serving
from tests.support.lessons import EXAMPLES, as_role, at_work, market
from tests.support.web.browser import Browser, Wallet
from tests.support.web.steps import anybody, sign
from tests.web.conftest import Site

__all__ = ["market"]

if TYPE_CHECKING:
    from collections.abc import Iterator

import pytest

VOLTS = (500, 1000, 1500, 2000, 2500, 3000)


@pytest.fixture
def lesson(market: dict[str, str]) -> Iterator[Browser]:
    """A browser with the person's wallet, at a market without robots."""
    folder = Path(market["AIRA_DATA_DIR"])
    password = (folder / "development" / "password").read_text().strip()
    key = bytes(Account.decrypt((folder / "development" / "person.json").read_text(), password))
    node = market["AIRA_WEB3_HTTP_PROVIDER"]
    site = Site("", "", "", node, key, market, folder)
    with site.page() as url, Browser(url, Wallet(key, node)) as browser:
        browser.go()
        browser.connect()
        yield browser


def choose(browser: Browser, example: str, objective: str) -> str:
    """The model by its CID, and the objective as a file; gives the model."""
    model = cid_of_file(EXAMPLES / example / "model.md")
    browser.go("order")
    browser.press("Another model")
    browser.type("CID of the model", model)
    browser.press("Go on")
    if objective:
        browser.click("#way-file")
        browser.find("input[type=file]").send_keys(str(EXAMPLES / example / objective))
        browser.find(".chosen-objective")
    else:
        browser.click("#way-none")
    return model


def recorded(browser: Browser) -> str:
    """The text of the recording's tables, all topics open."""
    browser.press("All messages")
    for topic in browser.all(".topic:not([open]) > summary"):
        topic.click()
    browser.until(lambda: browser.all(".topic td"), "the messages")
    return "\n".join(topic.text for topic in browser.all(".topic"))


@pytest.mark.full
def test_hello_blink_colours_and_sensor(lesson: Browser, market: dict[str, str]) -> None:
    """One market for all four lessons, one robot after the other."""
    hello = EXAMPLES / "hello_mesh"
    greeter = (sys.executable, hello / "agent.py")
    with (
        Serving(*greeter, says="watching on", variables={"AIRA_CONNECT": market["AIRA_CONNECT"]}) as greets,
        Serving(sys.executable, hello / "robot.py", says="account 0x", variables=as_role("robot", market)),
    ):
        choose(lesson, "hello_mesh", "blink.mcap")
        sign(lesson)
        lesson.sees("the robot was paid")
        greets.wait_until_said(f"Hello {lesson.wallet.address if lesson.wallet else ''}, you would pay")
    with at_work("blink", "blink", "frames", market) as uno:
        choose(lesson, "blink", "blink.mcap")
        sign(lesson)
        lesson.sees("the robot was paid")
        assert [change.high for change in uno.changes(13)].count(True) >= 3
        lesson.until(lambda: "off" in recorded(lesson), "the lamp's end")
    with at_work("blink_arguments", "colours", "frames", market) as uno:
        choose(lesson, "blink_arguments", "blue.mcap")
        sign(lesson)
        lesson.sees("the robot was paid")
        assert [change.high for change in uno.changes(12)].count(True) >= 3
        choose(lesson, "blink_arguments", "green.mcap")
        sign(lesson)
        lesson.sees("The price went back")
        lesson.sees("there is no green lamp")
    with at_work("air_pollution", "air", "frames", market) as uno:
        for channel, volts in enumerate(VOLTS):
            uno.set_voltage(channel, volts)
        choose(lesson, "air_pollution", "")
        anybody(lesson)
        lesson.type("You pay", "0")
        lesson.click("#order:not([disabled])")
        lesson.click("#sign")
        lesson.sees("A robot answered, without a contract")
        lesson.until(lambda: "/measurements" in recorded(lesson), "the measurement")
        lesson.sees("2.5")
        lesson.find(".panel .badge.good")
