"""Steps of people on the page, which several tests take."""

from __future__ import annotations

import json
import urllib.request
from typing import TYPE_CHECKING, Any, Final

from tests.support.web.browser import DESKTOP, PHONE

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.web.browser import Browser
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


def order_locally(browser: Browser, site: Site, *, seconds: float) -> None:
    """The same with the local account of the server."""
    browser.go()
    browser.find("#account")
    fill_in(browser, site, seconds=seconds)
    browser.click("#order:not([disabled])")
    browser.click("#sign")
    browser.until(lambda: "#/job/" in browser.driver.current_url, "the job")


def facts(site: Site, path: str) -> Any:
    """What the page's server answers."""
    with urllib.request.urlopen(f"{site.url}/api/v1/{path}", timeout=30) as response:
        return json.load(response)


OVERLAPS: Final = """
const page = [...document.querySelectorAll("dialog[open]")].at(-1) ?? document.getElementById("page") ?? document.body;
const blockOf = (one) => (getComputedStyle(one).display === "inline" ? blockOf(one.parentElement) : one);
const texts = document.createTreeWalker(page, NodeFilter.SHOW_TEXT), boxes = [];
while (texts.nextNode()) {
  const { currentNode: node } = texts, element = node.parentElement;
  if (!node.data.trim() || !element.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
  if (element.closest("nav, .notes, .hidden, .skip, .states, .u-wrap, details:not([open]) > :not(summary)")) continue;
  const range = document.createRange();
  range.selectNodeContents(node);
  let { left, top, right, bottom } = range.getBoundingClientRect();
  for (let one = element; one && one !== page; one = one.parentElement) {  // what is cut off covers nothing
    const style = getComputedStyle(one);
    if (style.overflow === "visible" && style.clipPath === "none") continue;
    const box = one.getBoundingClientRect();
    [left, top] = [Math.max(left, box.left), Math.max(top, box.top)];
    [right, bottom] = [Math.min(right, box.right), Math.min(bottom, box.bottom)];
  }
  const text = node.data.trim().slice(0, 40), block = blockOf(element);
  if (right - left > 4 && bottom - top > 4) boxes.push({ text, block, left, top, right, bottom });
}
const found = [];
boxes.forEach((one, place) => {
  for (const other of boxes.slice(place + 1)) {
    const wide = Math.min(one.right, other.right) - Math.max(one.left, other.left);
    const high = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top);
    const isOneText = one.block.contains(other.block) || other.block.contains(one.block);  // its lines may be broken
    if (wide > 4 && high > 6 && !isOneText) found.push(`${one.text} | ${other.text}`);
  }
});
return found;
"""
"""Texts that cover each other."""


def check_looks(browser: Browser, pictures: Path, name: str) -> None:
    """Check what is shown on a desk and on a phone, light and dark."""
    for size in (PHONE, DESKTOP):
        for dark in (True, False):
            browser.resize(size)
            browser.set_dark(dark)
            check(browser, pictures / f"{name}-{look(size, dark)}")


def look(size: tuple[int, int], dark: bool) -> str:
    """How the file of a screenshot ends."""
    return f"{'phone' if size == PHONE else 'desktop'}-{'dark' if dark else 'light'}.png"


def check(browser: Browser, picture: Path) -> None:
    """No violations, no text over another; on a phone nothing to scroll sideways, not even a table; and a screenshot
    for people."""
    browser.picture(picture)
    assert browser.violations() == [], picture.stem
    assert browser.driver.execute_script(OVERLAPS) == [], f"{picture.stem}: texts cover each other"
    wider = browser.driver.execute_script(
        "const all = innerWidth < 600 ? ':root, .scroll, p' : ':root';"
        "return [...document.querySelectorAll(all)].filter((one) => one.scrollWidth > one.clientWidth)"
        ".map((one) => one.ariaLabel ?? (one.matches('p') ? one.textContent : 'the page'))"
    )
    assert not wider, f"{picture.stem}: wider than the screen: {wider}"
