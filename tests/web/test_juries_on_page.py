"""The page in generation 5: a validator is a jury, of which enough jurors must answer."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.support.commands import aira
from tests.web.browser import Browser
from tests.web.steps import fill_in

if TYPE_CHECKING:
    from tests.web.conftest import Site


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
        browser.sees("2 of its 2 jurors are here, 2 must judge alike")
        browser.sees("This browser checked it, through your wallet's node")
        browser.until(lambda: browser.all("#allow") or browser.all("#order:not([disabled])"), "a way to go on")
