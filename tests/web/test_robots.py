"""Robots as people see them: choosing the cheaper one, watching it, stopping it; and running one's own."""

from __future__ import annotations

import csv
import io
import json
import sys
import threading
import urllib.request
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, Final
from urllib.error import HTTPError

import pytest
from selenium.webdriver.common.keys import Keys

from tests.support.commands import Serving, aira
from tests.support.web.browser import Browser
from tests.support.web.steps import check, check_looks, facts, fill_in, sign
from tests.web.conftest import HERE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.web.conftest import Site


CLICKS: Final = "window.clicks = 0; addEventListener('click', (event) => { clicks += event.isTrusted; }, true)"


@contextmanager
def named_robot(site: Site, name: str, **variables: str) -> Iterator[str]:
    """A further robot of the model; gives its address."""
    keyfile, data = site.folder / f"{name}.json", site.folder / name
    password = site.variables["AIRA_KEYFILE_PASSWORD_FILE"]
    address = str(aira("account", "new", keyfile, "--password-file", password).stdout.strip())
    own = {"AIRA_KEYFILE": str(keyfile), "AIRA_DATA_DIR": str(data), "AIRA_NAME": name, "AIRA_OPEN_SERVICES": "true"}
    robot = (sys.executable, HERE / "robot.py", site.folder / "model.json")
    with Serving(*robot, says="robot 0x", variables=site.variables | own | variables):
        yield address


@pytest.fixture(scope="module")
def told() -> Iterator[tuple[str, list[Any]]]:
    """A server of an owner: its URL, and the events that it has got."""
    taken: list[Any] = []

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            taken.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Receiver) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/robots", taken
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def scout(site: Site, told: tuple[str, list[Any]]) -> Iterator[str]:
    """A robot that is cheaper, and whose owner is told what happens to it; gives its address."""
    about = {"AIRA_ABOUT": "Small and quick.", "ROBOT_PRICE": "2.5 XRT"}
    with named_robot(site, "Scout", AIRA_NOTIFY=told[0], **about) as address:
        yield address


def test_a_newcomer_orders_from_the_cheaper_robot_watches_it_and_stops_it(
    site: Site, scout: str, pictures: Path
) -> None:
    def balance() -> int:
        return int(facts(site, f"accounts/{site.wallet().address}")["token"]["balance"])

    other = named_robot(site, "Digger", ROBOT_PRICE="4 XRT")
    with other, site.page(keyfile=True) as url, Browser(url) as browser:
        browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": CLICKS})
        browser.go()
        browser.sees("Scout")
        browser.sees("Digger")
        check_looks(browser, pictures, "robots")
        browser.press("Order")
        browser.click(f"#{browser.label('Duration').get_attribute('for')}")
        for key in (Keys.HOME, Keys.DELETE, "6", "0"):
            browser.keys(key)
        browser.until(lambda: len(browser.all(".quote [value]")) > 1, "the quotes")
        prices = [float(price.text.split()[0]) for price in browser.all(".quote .price-tag")]
        assert min(prices) == 2.5 < max(prices)
        browser.click(f".quote [value='{scout}']")
        check_looks(browser, pictures, "quotes")
        browser.click("#order:not([disabled])")
        assert "Duration\n60 s" in browser.find("#in-words").text
        assert "2.5 XRT" in browser.find("dialog[open]").text
        browser.sees("You get the price back.")
        before = balance()
        browser.click("#sign")
        browser.until(lambda: "#/job/" in browser.driver.current_url, "the job")
        assert browser.driver.execute_script("return clicks") == 5
        browser.until(lambda: balance() == before - 2_500_000_000, "the price in the contract")
        job = browser.driver.current_url
        browser.find(".track .path canvas")
        shown = [browser.find(".path figcaption").text]
        browser.until(lambda: browser.find(".path figcaption").text not in shown, "the next position")
        browser.driver.refresh()  # what came before is shown again
        browser.sees("/position")
        check_looks(browser, pictures, "job")
        browser.click("#stop")
        browser.sees("You get the price back.")
        browser.click("#stop-now")
        browser.sees("You stopped it. The price went back.")
        assert browser.driver.current_url == job
        path = f"liabilities/{job.rpartition('/')[2]}"  # of another server, which may be a block behind
        browser.until(lambda: facts(site, path)["liability"]["state"] == "failed", "the refund")
        contract = facts(site, path)
        assert contract["liability"]["promisor"] == scout
        assert balance() == before
        # For one robot alone: the other server knows the contract, and has never seen the order.
        with pytest.raises(HTTPError, match="404"):
            facts(site, f"orders/{contract['demandHash']}")


def test_a_wallet_orders_from_one_robot_and_stops_it(browser: Browser, site: Site, scout: str) -> None:
    browser.go()
    browser.connect()
    fill_in(browser, site, seconds=60)
    browser.click(f".quote [value='{scout}']")
    job = sign(browser)
    assert browser.wallet
    assert browser.wallet.calls.count("personal_sign") == 3
    browser.click("#stop")
    browser.click("#stop-now")
    browser.sees("You stopped it. The price went back.")
    assert facts(site, f"liabilities/{job}")["liability"]["promisor"] == scout
    with Browser(site.url) as stranger:
        stranger.go(f"job/{job}")
        stranger.sees("Its customer stopped it. The price went back.")


def test_an_owner_changes_the_price_sees_the_notification_and_its_job_and_downloads_the_statement(
    site: Site, scout: str, told: tuple[str, list[Any]], pictures: Path
) -> None:
    with site.page(keyfile=True) as url, Browser(url) as browser:
        browser.go(f"order/model/{site.model}/{scout}")
        browser.type("Duration", "1")
        browser.click(f".quote [value='{scout}']")
        browser.click("#order:not([disabled])")
        browser.click("#sign")
        browser.sees("the robot was paid")
        job = browser.driver.current_url
        browser.go(f"robot/{scout}")
        browser.type("Price of a job", "3")
        browser.click("#set-price")
        browser.until(lambda: browser.find(".hero .price-tag").text == "3 XRT", "the new price")
        browser.until(lambda: "Job paid" in browser.find(".events li").text, "the notification")
        browser.sees("They are sent to 127.0.0.1.")
        browser.until(lambda: told[1] and told[1][-1]["type"] == "aira.job-paid", "the owner's event")
        assert job.endswith(told[1][-1]["subject"])
        browser.press("Show the job")
        browser.sees("the robot was paid")
        assert browser.driver.current_url == job
        browser.driver.back()
        browser.type("Lowest price it accepts", "3")
        browser.click("#set-least")
        browser.sees("Saved.")
        browser.click("#pause")
        browser.sees("It finishes its jobs and takes no new ones.")
        browser.sees("takes no jobs now")
        browser.until(lambda: "2.5 XRT" in browser.find(".owner .lead").text, "the income")
        check_looks(browser, pictures, "owner")
        with urllib.request.urlopen(browser.find("#statement").get_attribute("href") or "", timeout=30) as answer:
            rows = list(csv.DictReader(io.StringIO(answer.read().decode())))
        assert [row["earned"] for row in rows if row["state"] == "paid"] == ["2.5"]
        browser.go(f"order/model/{site.model}/{scout}")
        browser.sees("declines")
        browser.go(f"robot/{scout}")
        browser.click("#pause")
        browser.sees("It takes jobs.")
        agents = facts(site, "agents")["agents"]
        other = next(one["address"] for one in agents if one["profile"] and one["address"] != scout)
        browser.go(f"robot/{other}")  # nobody is told what happens to this one
        browser.sees("They are sent to nobody.")
        browser.sees("notify = [")
        check(browser, pictures / "owner-nobody-told.png")


def test_a_robot_that_left_stands_as_away_with_what_it_read_and_did_before_anybody_looked(
    site: Site, pictures: Path
) -> None:
    with site.page() as url, Browser(url, site.wallet()) as browser:
        with named_robot(site, "Rover", ROBOT_READS="1") as rover:
            browser.go("jobs")  # the server is looked at, and the robot is not
            browser.until(lambda: charges(url, rover), "readings that nobody has asked for")
            before = charges(url, rover)
            browser.go()
            browser.sees("Rover")
            browser.connect()
            fill_in(browser, site)
            browser.click(f".quote [value='{rover}']")
            job = sign(browser)
            browser.sees("the robot was paid")
            browser.go()
        browser.sees("away since")
        assert not browser.all(f".robots a[href*='{rover}']")
        check_looks(browser, pictures, "away")
        browser.press("Rover")
        browser.sees("What it read last")
        browser.find(".tracks canvas")
        assert charges(url, rover)[: len(before)] == before
        browser.find(f".list-row[href='#/job/{job}']")
        assert not browser.all("a[href*='#/order/model/']")
        check_looks(browser, pictures, "robot-away")


def charges(url: str, robot: str) -> list[float]:
    """What the robot's battery had, as the page's server knows it; the last ones may still be replaced."""
    with urllib.request.urlopen(f"{url}/api/v1/agents/{robot}/readings", timeout=30) as answer:
        return [sample["value"] for sample in json.load(answer)["readings"].get("/battery", ())][:-2]
