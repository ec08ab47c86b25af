"""The page in a real Chromium: orders by clicks, wallets that say no, a server that lies, strangers' texts."""

from __future__ import annotations

import sys
import urllib.request
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import pytest
from selenium.webdriver.common.keys import Keys

from tests.support.commands import Serving
from tests.support.ports import free_port
from tests.support.web.browser import DESKTOP, PHONE, Browser
from tests.support.web.steps import anybody, check, facts, fill_in, look, order, review, sign

UNBUFFERED = {"PYTHONUNBUFFERED": "1"}

if TYPE_CHECKING:
    from pathlib import Path

    from tests.web.conftest import Site


def test_a_job_is_ordered_paid_and_checked_by_clicks(browser: Browser, site: Site) -> None:
    browser.go()
    browser.connect()
    fill_in(browser, site)
    sign(browser)
    job = browser.driver.current_url
    browser.driver.refresh()  # in the middle of the job
    browser.sees("the robot was paid")
    browser.until(lambda: len(browser.all(".findings .badge.good")) >= 19, "all checks")
    assert not browser.all(".findings .badge.bad")
    browser.find(".path canvas, .path svg")
    browser.find(".picture img")
    # What the robot said is a stranger's text: shown, and nothing else.
    browser.sees("<script>")
    assert "hacked" not in browser.driver.title
    assert "\u202e" not in browser.text()
    assert browser.log() == []
    assert browser.driver.current_url == job
    assert browser.violations() == []
    # The recording, for other programs: a download, and a link that Foxglove opens.
    recording = browser.find("a[download]").get_attribute("href") or ""
    with urllib.request.urlopen(recording, timeout=30) as response:
        assert response.read(5) == b"\x89MCAP"
    foxglove = browser.find("a[href^='foxglove:']").get_attribute("href") or ""
    assert parse_qs(urlsplit(foxglove).query) == {"ds": ["remote-file"], "ds.url": [recording]}


def test_what_failed_is_paid_back(browser: Browser, site: Site) -> None:
    browser.go()
    browser.connect()
    fill_in(browser, site, direction="into the wall")
    review(browser)
    browser.click("#sign")
    browser.sees("The price went back")
    browser.sees("there is a wall")


def test_a_no_in_the_wallet_sends_nothing(browser: Browser, site: Site) -> None:
    assert browser.wallet
    browser.wallet.rejects.add("personal_sign")
    browser.go()
    browser.connect()
    fill_in(browser, site)
    review(browser)
    browser.click("#sign")
    browser.sees("You rejected it in the wallet")
    browser.wallet.rejects.clear()
    browser.click("#sign")
    browser.until(lambda: "#/job/" in browser.driver.current_url, "the job")


def test_a_wrong_chain_is_fixed_by_a_button(browser: Browser, site: Site) -> None:
    assert browser.wallet
    browser.wallet.chain_id += 1
    browser.go()
    browser.connect()
    fill_in(browser, site)
    browser.click("#fix-chain")
    browser.until(lambda: not browser.all("#fix-chain"), "the right chain")
    assert "wallet_switchEthereumChain" in browser.wallet.calls


def test_an_account_without_money_is_told(site: Site) -> None:
    with Browser(site.url, site.poor_wallet()) as browser:
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.sees("This account has 0 XRT")
        assert not browser.find("#order").is_enabled()


NOBODYS_MODEL = "QmS9JArPwa55ePgDnyg6TzX24mYTS1b1vLqWNebyVotKxQ"


def order_of_nobodys_model(browser: Browser, site: Site) -> None:
    """An order that stays open."""
    fill_in(browser, site)
    review(browser)
    objective = browser.find("#objective .name").get_attribute("title")
    browser.go(f"order/model/{NOBODYS_MODEL}")
    browser.click("#way-cid")
    browser.type("CID of the objective", objective or "")
    browser.find(".chosen-objective")
    browser.click("#order:not([disabled])")
    browser.click("#sign")


def test_an_open_order_is_withdrawn(browser: Browser, site: Site) -> None:
    browser.go()
    browser.connect()
    order_of_nobodys_model(browser, site)
    browser.click("#withdraw")
    browser.sees("You withdrew this order")


def test_a_page_outlives_its_server(site: Site) -> None:
    port = free_port()
    with Browser(f"http://127.0.0.1:{port}", site.wallet()) as browser:
        with site.page(port=port):
            browser.go("market")
            browser.sees("Live")
            browser.connect()
            order_of_nobodys_model(browser, site)
            browser.sees("Your order is in the market")
        browser.sees("Connection lost")
        with site.page(port=port):
            browser.sees("Live")
            # The server knows the order again, because the page has posted it again.
            browser.driver.refresh()
            browser.sees("Your order is in the market")


def test_an_order_shows_in_the_market_of_another_tab(browser: Browser, site: Site, pictures: Path) -> None:
    with Browser(site.url, size=PHONE) as other:
        other.go("market")
        other.sees("Live")
        browser.go()
        browser.connect()
        fill_in(browser, site)
        anybody(browser)
        review(browser)
        browser.click("#sign")
        browser.until(lambda: "#/job/" in browser.driver.current_url, "the job")
        other.until(lambda: other.all(".kind.demand") and other.all(".kind.offer"), "the demand and the offer")
        other.sees("ready")
        check(other, pictures / "market-with-an-order.png")
        matched = other.find("tr:has(.kind.matched) a")
        assert matched.text.startswith("0x")
        assert matched.get_attribute("href") == browser.driver.current_url
        assert other.log() == []


def test_two_tabs_of_a_person_show_the_same_job(browser: Browser, site: Site) -> None:
    browser.go()
    browser.connect()
    first = browser.driver.current_window_handle
    browser.driver.switch_to.new_window("tab")
    second = browser.driver.current_window_handle
    browser.start_wallet()
    browser.go("jobs")
    browser.find("#account")  # the wallet is known here, too
    browser.driver.switch_to.window(first)
    job = order(browser, site)
    browser.driver.switch_to.window(second)
    browser.click(f"[title='{job}'] a")
    browser.sees("the robot was paid")
    browser.driver.switch_to.window(first)
    browser.sees("the robot was paid")


def test_an_order_needs_no_mouse(browser: Browser, site: Site) -> None:
    browser.go(f"order/model/{site.model}")
    browser.find(".form")
    browser.keys(Keys.TAB, Keys.ENTER)  # skip what all pages have
    assert browser.driver.execute_script("return document.activeElement.id") == "main"
    browser.tab_to("#connect")
    browser.keys(Keys.ENTER)
    browser.tab_to(".choice")
    browser.keys(Keys.ENTER)
    browser.find("#account")
    browser.until(lambda: browser.all("#allow") or browser.all("#order:not([disabled])"), "a way to go on")
    if browser.all("#allow"):
        browser.tab_to("#allow")
        browser.keys(Keys.ENTER)
    browser.find("#order:not([disabled])")
    browser.tab_to("#order")
    browser.keys(Keys.ENTER)
    browser.sees("This is what you sign")
    browser.tab_to("#sign")
    browser.keys(Keys.ENTER)
    browser.sees("the robot was paid")


def test_the_local_account_orders_and_is_labelled(site: Site) -> None:
    with site.page(keyfile=True) as url, Browser(url) as browser:
        browser.go()
        browser.sees("Local account")
        fill_in(browser, site)
        browser.sees("You order with the local account of this server")
        browser.click("#order:not([disabled])")
        browser.click("#sign")
        browser.sees("the robot was paid")


def test_a_robots_own_page_has_one_button_and_fits_in_a_frame(site: Site, tmp_path: Path, pictures: Path) -> None:
    origin = f"http://127.0.0.1:{free_port()}"
    with site.page("--model", site.model, "--cost", "2", "--embed", origin) as url:
        (tmp_path / "index.html").write_text(f'<!doctype html><iframe src="{url}/" width="500" height="800"></iframe>')
        serve = (sys.executable, "-m", "http.server", "--bind", "127.0.0.1", "--directory", tmp_path)
        with (
            Serving(*serve, origin.rpartition(":")[2], says="Serving HTTP", variables=UNBUFFERED),
            Browser(origin, site.wallet()) as browser,
        ):
            browser.driver.get(origin)
            browser.driver.switch_to.frame(0)
            browser.sees("Drive a circle")
            browser.sees("2 XRT")
            browser.picture(pictures / "robot-frame.png")
            assert browser.violations() == []
            browser.connect()
            sign(browser)
            browser.sees("the robot was paid")
        other = f"http://localhost:{origin.rpartition(':')[2]}"
        with (
            Serving(*serve, origin.rpartition(":")[2], says="Serving HTTP", variables=UNBUFFERED),
            Browser(other) as browser,
        ):
            browser.driver.get(other)
            browser.driver.switch_to.frame(0)
            assert "Drive a circle" not in browser.text()


@pytest.mark.sample("size", "dark")
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_each_page_is_accessible(site: Site, paid_job: str, pictures: Path, size: tuple[int, int], dark: bool) -> None:
    with Browser(site.url, site.wallet(), size=size, dark=dark) as browser:
        browser.go()
        browser.connect()
        assert browser.wallet
        robot = facts(site, f"liabilities/{paid_job}")["liability"]["promisor"]
        routes = {"home": "", "robot": f"robot/{robot}", "market": "market", "jobs": "jobs", "site": "site"}
        routes |= {"lighthouse": "site/lighthouse", "account": f"account/{browser.wallet.address}"}
        routes |= {"job-done": f"job/{paid_job}"}
        for name, route in routes.items():
            browser.go(route)
            browser.until(lambda: not browser.all("[aria-busy=true]") and browser.all("h1"), name)
            if name == "site":
                browser.press("Details")
                browser.click("#log summary")
                browser.until(lambda: not browser.all("[aria-busy=true]"), "the log")
            if name == "job-done":
                browser.until(lambda: len(browser.all(".findings .badge.good")) >= 18, "all checks")
                browser.find(".path canvas, .path svg")
            check(browser, pictures / f"{name}-{look(size, dark)}")
        fill_in(browser, site)
        review(browser)
        check(browser, pictures / f"review-{look(size, dark)}")
        browser.press("Not now")
        check(browser, pictures / f"form-{look(size, dark)}")
