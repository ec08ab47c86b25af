"""Steps of people on the page, which several tests take."""

from __future__ import annotations

import json
import urllib.request
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from tests.web.browser import Browser
    from tests.web.conftest import Site


def fill_in(browser: Browser, site: Site, *, direction: str = "left", seconds: float = 2) -> None:
    """From the link to a model until the price is asked."""
    browser.go(f"order/model/{site.model}")
    browser.find(".form select")
    browser.driver.execute_script(
        "const one = [...document.querySelectorAll('fieldset select')].at(-1);"
        "one.value = [...one.options].find((option) => option.text === arguments[0]).value;"
        "one.dispatchEvent(new Event('change', { bubbles: true }))",
        direction,
    )
    browser.type("Duration", str(seconds))


def anybody(browser: Browser) -> None:
    """Let whoever takes the order first do it: such an order is public."""
    browser.click("#anybody")


def review(browser: Browser) -> str:
    """From the price to the terms that are signed; gives the hash that is shown."""
    browser.until(lambda: browser.all("#allow") or browser.all("#order:not([disabled])"), "a way to go on")
    if browser.all("#allow"):
        browser.click("#allow")
    browser.click("#order:not([disabled])")
    return browser.find("#hash").text


def objective_values(site: Site, cid: str) -> list[Any]:
    """The values of the messages in an objective."""
    return [message["value"] for message in facts(site, f"files/{cid}/messages")["messages"]]


def sign(browser: Browser) -> str:
    """From the price to the job; gives its address."""
    review(browser)
    browser.click("#sign")
    # The part of the address that a frame has, too.
    route = browser.until(lambda: browser.driver.execute_script("return location.hash.match(/^#.job.(.*)/)"), "the job")
    return str(route[1])


def order(browser: Browser, site: Site, *, direction: str = "left", seconds: float = 2) -> str:
    """A whole order by clicks, with a wallet that is connected first; gives the job's address."""
    if not browser.all("#account"):
        browser.go()
        browser.connect()
    fill_in(browser, site, direction=direction, seconds=seconds)
    return sign(browser)


def facts(site: Site, path: str) -> Any:
    """What the page's server answers."""
    with urllib.request.urlopen(f"{site.url}/api/v1/{path}", timeout=30) as response:
        return json.load(response)


def check(browser: Browser, picture: Path) -> None:
    """No violations; on a phone nothing to scroll sideways, not even a table; and a screenshot for people."""
    browser.picture(picture)
    assert browser.violations() == [], picture.stem
    wider = browser.driver.execute_script(
        "const all = innerWidth < 600 ? ':root, .scroll' : ':root';"
        "return [...document.querySelectorAll(all)].filter((one) => one.scrollWidth > one.clientWidth)"
        ".map((one) => one.ariaLabel ?? 'the page')"
    )
    assert not wider, f"{picture.stem}: wider than the screen: {wider}"
