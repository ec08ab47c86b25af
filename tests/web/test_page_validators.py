"""The page shows how a validator judges before an order names it: an account in generation 3, a jury in 5."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from selenium.webdriver.common.keys import Keys

from tests.support.commands import aira
from tests.support.web.browser import DESKTOP, PHONE, Browser
from tests.support.web.steps import check, facts, fill_in, sign

if TYPE_CHECKING:
    from pathlib import Path

    from tests.web.conftest import Site


@pytest.mark.full
def test_a_validator_says_how_it_judges_before_it_is_named(browser: Browser, site: Site, pictures: Path) -> None:
    market = facts(site, "market")
    (validator,) = market["providers"]
    policies = ("--validator-policies", "acknowledged:within=5s", "--validator-title", "Driving examiners <b>")
    with site.validator(*policies, "--validator-fee", "0.25"):
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.press("With a validator")
        person = site.wallet()
        person.give(person.address)  # orders may name accounts that have sent a transaction
        for named, fee, refusal in (
            (market["lighthouse"]["address"], "", "it may be a lighthouse"),
            (site.poor_wallet().address, "", "an account that has sent a transaction"),
            (person.address, "", "nobody answers as this validator on the mesh"),
            (validator, "0.1", "the fee is 0.1 XRT, but the validator wants 0.25 XRT"),
        ):
            browser.type("Validator", named)
            browser.type("Fee of the validator", fee or Keys.BACKSPACE)
            browser.sees(refusal)
            assert not browser.find("#order, #allow:not([disabled])").is_enabled()
        browser.type("Fee of the validator", Keys.BACKSPACE)
        browser.sees("Each command is answered by the device within 5 s.")
        browser.sees("Driving examiners <b>")
        browser.sees("0.25 XRT, on top of the price")
        browser.sees("cost and fee can be refunded 50,400 blocks")
        browser.sees("This browser checked it, through your wallet's node")
        for look, size in (("phone", PHONE), ("desktop", DESKTOP)):
            browser.resize(size)
            check(browser, pictures / f"validator-{look}.png")
        sign(browser)
        browser.sees("the robot was paid")
        browser.sees("the work counts")
        browser.go("site")
        browser.click(f"tr:has([title='{validator}']):has([data-role='validator']) button[aria-expanded]")
        browser.sees("complete, acknowledged")
        check(browser, pictures / "validator-robots.png")


@pytest.mark.full
def test_a_jury_is_named_once_enough_jurors_answer(site: Site) -> None:
    in_5 = ("--generation", "5")
    keeper = {"AIRA_KEYFILE": f"{site.folder}/development/provider.json"}
    accounts = [json.loads((site.folder / f"development/{role}.json").read_text()) for role in ("provider", "robot")]
    named = [word for one in accounts for word in ("--juror", f"0x{one['address'].removeprefix('0x')}")]
    made = aira("validator", "deploy", "--json", *in_5, *named, "--quorum", "2", **(site.variables | keeper))
    jury = json.loads(made.stdout)["validator"]
    juror = (*in_5, "--validator-contract", jury)
    with site.page(*in_5) as url, Browser(url, site.wallet()) as browser, site.validator(*juror):
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.press("With a validator")
        browser.type("Validator", site.wallet().address)
        browser.sees("there is no contract at the validator's address")
        browser.type("Validator", jury)
        browser.sees("only 1 of the 2 jurors that must judge alike answer")
        assert not browser.find("#order").is_enabled()
    with (
        site.validator(*juror),
        site.validator(*juror, role="robot"),
        site.page(*in_5) as url,
        Browser(url, site.wallet()) as browser,
    ):
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.press("With a validator")
        browser.type("Validator", jury)
        browser.sees("2 of its 2 jurors are here, 2 must agree")
        browser.sees("This browser checked it, through your wallet's node")
        browser.until(lambda: browser.all("#allow") or browser.all("#order:not([disabled])"), "a way to go on")
