"""Robots as people see them: choosing the cheaper one, watching it, stopping it; and running one's own."""

from __future__ import annotations

import csv
import io
import sys
import urllib.request
from typing import TYPE_CHECKING
from urllib.error import HTTPError

import pytest

from tests.support.commands import Serving, aira
from tests.web.browser import DESKTOP, PHONE, Browser
from tests.web.conftest import HERE
from tests.web.steps import check, facts, fill_in, sign

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.web.conftest import Site


@pytest.fixture(scope="module")
def scout(site: Site) -> Iterator[str]:
    """A second robot of the model, which has a name and is cheaper; gives its address."""
    keyfile, data = site.folder / "scout.json", site.folder / "scout"
    password = site.variables["AIRA_KEYFILE_PASSWORD_FILE"]
    address = str(aira("account", "new", keyfile, "--password-file", password).stdout.strip())
    variables = site.variables | {
        "AIRA_KEYFILE": str(keyfile),
        "AIRA_DATA_DIR": str(data),
        "AIRA_NAME": "Scout",
        "AIRA_ABOUT": "Small and quick.",
        "AIRA_OPEN_SERVICES": "true",
        "ROBOT_PRICE": "2.5 XRT",
    }
    robot = (sys.executable, HERE / "robot.py", site.folder / "model.json")
    with Serving(*robot, says="robot 0x", variables=variables):
        yield address


def test_a_newcomer_orders_from_the_cheaper_robot_watches_it_and_stops_it(
    site: Site, scout: str, pictures: Path
) -> None:
    with site.page(keyfile=True) as url, Browser(url) as browser:
        browser.go()
        browser.sees("Scout")
        check(browser, pictures / "robots-two.png")
        browser.press("Order")
        browser.type("Duration", "60")
        browser.until(lambda: len(browser.all(".quote")) > 1, "the quotes")
        browser.click(f".quote [value='{scout}']")
        browser.sees("2.5 XRT")
        check(browser, pictures / "quotes.png")
        browser.click("#order:not([disabled])")
        assert "Duration\n60 s" in browser.find("#in-words").text
        browser.sees("You get the price back.")
        browser.click("#sign")
        browser.until(lambda: "#/job/" in browser.driver.current_url, "the job")
        job = browser.driver.current_url
        browser.until(lambda: browser.all(".topics canvas, .track canvas, canvas"), "the path")
        browser.driver.refresh()  # what came before is shown again
        browser.sees("/position")
        check(browser, pictures / "job-live.png")
        browser.click("#stop")
        browser.sees("You get the price back.")
        browser.click("#stop-now")
        browser.sees("You stopped it. The price went back.")
        assert browser.driver.current_url == job
        path = f"liabilities/{job.rpartition('/')[2]}"  # of another server, which may be a block behind
        browser.until(lambda: facts(site, path)["liability"]["state"] == "failed", "the refund")
        contract = facts(site, path)
        assert contract["liability"]["promisor"] == scout
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


def test_an_owner_changes_the_price_pauses_and_reads_the_income(site: Site, scout: str, pictures: Path) -> None:
    with site.page(keyfile=True) as url, Browser(url) as browser:
        browser.go(f"order/model/{site.model}/{scout}")
        browser.type("Duration", "1")
        browser.click(f".quote [value='{scout}']")
        browser.click("#order:not([disabled])")
        browser.click("#sign")
        browser.sees("the robot was paid")
        browser.go(f"robot/{scout}")
        browser.type("Works for no less than", "3")
        browser.click("#set-least")
        browser.sees("Saved.")
        browser.click("#pause")
        browser.sees("It finishes what it has, and takes nothing new.")
        browser.sees("takes no jobs now")
        browser.until(lambda: "2.5 XRT" in browser.find(".owner .lead").text, "the income")
        for look, size in (("desktop", DESKTOP), ("phone", PHONE)):
            browser.resize(size)
            check(browser, pictures / f"owner-{look}.png")
        with urllib.request.urlopen(browser.find("#statement").get_attribute("href") or "", timeout=30) as answer:
            rows = list(csv.DictReader(io.StringIO(answer.read().decode())))
        assert [row["earned"] for row in rows if row["state"] == "paid"] == ["2.5"]
        browser.go(f"order/model/{site.model}/{scout}")
        browser.sees("declines")
        browser.go(f"robot/{scout}")
        browser.click("#pause")
        browser.sees("It takes jobs.")
