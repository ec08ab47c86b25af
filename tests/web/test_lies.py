"""Servers that lie, and strangers that send scripts: the page catches the ones, and shows the others as text.

The page's own requests pass a script that alters the answers, as a lying server would.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.objectives import objective
from tests.support.web.browser import Browser
from tests.support.web.steps import anybody, facts, fill_in, review, sign
from tests.web.conftest import HOSTILE

if TYPE_CHECKING:
    from pathlib import Path

    from tests.web.conftest import Site

JOB = r"liabilities\/0x\w{40}$"
OTHER = "QmS9JArPwa55ePgDnyg6TzX24mYTS1b1vLqWNebyVotKxQ"
LIES = {
    "price": (JOB, "body.liability.cost = '1'"),
    "outcome": (JOB, "body.liability.isSuccess = false"),
    "robot": (JOB, "body.liability.promisor = body.liability.promisee"),
    "signature": (JOB, "body.resultMessage.signature = body.resultMessage.signature.replace(/^.{8}/, '12345678')"),
    "result": (JOB, f"body.resultMessage.result = '{OTHER}'"),
    "recording": (r"files\/\w+$", "body[body.length >> 1] ^= 1"),
}


@pytest.mark.sample("lie")
@pytest.mark.parametrize("lie", LIES)
def test_a_lie_about_a_job_is_caught(site: Site, paid_job: str, lie: str) -> None:
    with Browser(site.url, site.wallet()) as browser:
        browser.go()
        browser.connect()
        browser.lie(*LIES[lie])
        browser.go(f"job/{paid_job}")
        browser.driver.refresh()
        assert "Don't trust this server" in browser.find("#lie").text
        browser.until(lambda: browser.all(".findings .badge.bad"), "the failed check")


@pytest.mark.sample("path", "change", "said")
@pytest.mark.parametrize(
    ("path", "change", "said"),
    [
        (r"v1\/orders$", "if (body.order) body.order.hash = 'ab'.repeat(32)", "about another order than the one shown"),
        (r"orders\/\w{64}$", "body.order.signer = '0x' + '12'.repeat(20)", "a signature that is not its maker's"),
        (r"orders\/\w{64}$", "body.order.cost = '1'", "about another order than the one shown"),
    ],
    ids=["hash", "signer", "terms"],
)
def test_a_lie_about_an_order_is_caught(browser: Browser, site: Site, path: str, change: str, said: str) -> None:
    browser.lie(path, change)
    browser.go()
    browser.connect()
    fill_in(browser, site, seconds=20)
    anybody(browser)
    review(browser)
    # No contract takes the order from the page before it is looked at.
    browser.lie(r"orders\/\w{64}$", "body.liability = null; body.state = 'open'")
    browser.click("#sign")
    browser.sees(said)


def test_a_server_that_stores_another_file_is_caught(browser: Browser, site: Site, tmp_path: Path) -> None:
    (tmp_path / "drive.mcap").write_bytes(objective(("/drive", "{}")))
    browser.lie(r"v1\/objectives\?", f"body.cid = '{OTHER}'")
    browser.go(f"order/model/{site.model}")
    browser.click("#way-file")
    browser.find("input[type=file]").send_keys(str(tmp_path / "drive.mcap"))
    browser.sees("stored another file than the one you sent")
    browser.connect()
    browser.until(lambda: browser.all("#allow") or browser.all("#order:not([disabled])"), "a way to go on")
    if browser.all("#allow"):
        browser.click("#allow")
    browser.click("#order:not([disabled])")
    browser.until(lambda: browser.text().count("stored another file") == 2, "the refusal")
    assert not browser.all("#sign")


def test_tokens_are_allowed_to_another_contract_only_after_a_warning(site: Site) -> None:
    wallet, rich = site.poor_wallet(), site.wallet()
    rich.give(wallet.address, token=facts(site, "market")["token"]["address"], units=10**10)
    rich.give(wallet.address, wei=10**17)
    with Browser(site.url, wallet) as browser:
        browser.go()
        browser.connect()
        fill_in(browser, site)
        sign(browser)
        browser.lie(r"v1\/market$", "body.factory = '0x' + '12'.repeat(20)")
        browser.lie(r"accounts\/0x\w+$", "body.token.allowance = body.xrt.allowance = '0'")
        fill_in(browser, site)
        browser.driver.refresh()
        browser.sees("another contract than the one that you allowed before")
        assert not browser.find("#order").is_enabled()
        browser.press("I know. Use the new contract")
        browser.click("#order:not([disabled])")
        assert "0x1212" in browser.find("#permit").text


def test_scripts_in_names_and_recordings_are_text(browser: Browser, site: Site, tmp_path: Path) -> None:
    """In a model's texts, in an objective's topics and messages, and in the name of a file."""
    browser.go(f"order/model/{site.hostile_model}")
    browser.sees("<script>")
    browser.find(".form")
    name = tmp_path / "<img src=x onerror=document.title=1>.mcap"
    name.write_bytes(objective((f"/{HOSTILE.replace('/', '')}", HOSTILE)))
    browser.click("#way-file")
    browser.find("input[type=file]").send_keys(str(name))
    browser.sees("Does not fit the model")
    browser.go(f"file/{browser.find('.chosen-objective .name').get_attribute('title')}")
    browser.press("All messages")
    browser.click(".topic summary")
    browser.until(lambda: "<script>" in browser.find(".topic table").text, "the message")
    assert browser.driver.title not in ("1", "hacked")
    assert not browser.all("#page script")
    assert not browser.all("#page img[src=x]")
    assert "\u202e" not in browser.text()
    assert browser.log() == []
    assert browser.violations() == []


@pytest.mark.full
@pytest.mark.parametrize(
    "lie",
    [
        "body.policies[0].description = 'Whatever the robot does.'",
        "body.announcedFee = body.fee = '1'",
        "body.title = body.announcements[0].text = body.announcements[0].text.replace('Examiners', 'Friends')",
        "body.announcements = []",
    ],
    ids=["policy", "fee", "title", "nothing"],
)
def test_a_lie_about_a_validator_is_caught(browser: Browser, site: Site, lie: str) -> None:
    with site.validator("--validator-title", "Examiners", "--validator-fee", "0.25"):
        browser.lie(r"validators\/", lie)
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.press("With a validator")
        browser.type("Validator", facts(site, "market")["providers"][0])
        browser.sees("Don't trust this server")
        assert not browser.find("#order").is_enabled()
