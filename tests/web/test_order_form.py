"""What is signed is what is shown: forms that are changed, and numbers that are typed key by key."""

from __future__ import annotations

import json
import re
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from selenium.webdriver.common.keys import Keys

from schemas.model import parse_description
from tests.support.objectives import objective
from tests.support.web.browser import DESKTOP, PHONE, Browser
from tests.support.web.steps import check, facts, fill_in, look, objective_values, review

if TYPE_CHECKING:
    from collections.abc import Iterator

    from selenium.webdriver.remote.webelement import WebElement

    from tests.web.conftest import Site

LARGEST = str(2**256 - 1)


def put(site: Site, data: bytes) -> str:
    """The CID of a file that the page's server now has."""
    headers = {"Content-Type": "application/octet-stream", "X-Aira-Request": "1"}
    request = urllib.request.Request(f"{site.url}/api/v1/objectives", data, headers)
    with urllib.request.urlopen(request, timeout=30) as response:
        return str(json.load(response)["cid"])


def field(browser: Browser, label: str) -> WebElement:
    """The field with this label, emptied and with the focus."""
    browser.type(label, Keys.BACKSPACE)
    return browser.driver.switch_to.active_element


def signed_values(browser: Browser, site: Site) -> list[object]:
    """The values in the objective of the order that the dialog shows."""
    found = browser.find("#objective .name").get_attribute("title")
    return objective_values(site, str(found))


@pytest.fixture
def form(browser: Browser, site: Site) -> Iterator[Browser]:
    """A browser at the form of a model with numbers."""
    text = (Path(__file__).parent / "number_model.json").read_bytes()
    model = put(site, parse_description(text).encode())
    browser.go()
    browser.connect()
    browser.go(f"order/model/{model}")
    browser.find(".form input")
    yield browser
    assert browser.log() == []


def test_the_paid_objective_has_the_values_that_the_form_had_last(browser: Browser, site: Site) -> None:
    browser.go()
    browser.connect()
    fill_in(browser, site, seconds=1)
    radius = field(browser, "Radius")
    for key in "3.5":
        radius.send_keys(key)
    review(browser)
    assert "Radius\n3.5 m" in browser.find("#in-words").text
    browser.press("Not now")
    browser.type("Radius", "1.25")
    review(browser)
    shown = browser.find("#in-words").text
    assert "Radius\n1.25 m" in shown
    assert "Direction\nleft" in shown
    browser.click("#sign")
    route = browser.until(lambda: browser.driver.execute_script("return location.hash.match(/^#.job.(.*)/)"), "the job")
    browser.sees("the robot was paid")
    paid = facts(site, f"liabilities/{route[1]}")["liability"]["objective"]
    assert objective_values(site, paid) == [{"metres": 1.25, "seconds": 1, "direction": "left"}]
    # One clock: no step of the timeline is before the one above it.
    steps = [step["at"] for step in facts(site, f"liabilities/{route[1]}")["timeline"] if step["at"]]
    assert steps == sorted(steps)
    assert len(steps) >= 4


def test_numbers_are_typed_key_by_key(form: Browser, site: Site) -> None:
    typed: dict[str | tuple[str, ...], float] = {
        "2.5": 2.5,
        "0.25": 0.25,
        "1.05": 1.05,
        "-7": -7,
        "-0.5": -0.5,
        ".5": 0.5,
        "2.": 2,
        "2,5": 2.5,
        "0.50": 0.5,
        "007": 7,
        "1e3": 1000,
        LARGEST: int(LARGEST),
        ("15", Keys.ARROW_LEFT, "."): 1.5,
        ("170", Keys.HOME, Keys.DELETE, Keys.END, Keys.BACKSPACE, ".2"): 7.2,
    }
    for keys, angle in typed.items():
        entered = field(form, "Angle")
        for key in "".join(keys):
            entered.send_keys(key)
        if isinstance(keys, str):
            assert entered.get_attribute("value") == keys
        review(form)
        assert re.search(rf"Angle\n{re.escape(str(angle))} °", form.find("#in-words").text), keys
        assert signed_values(form, site) == [{"angle": angle, "ticks": 0, "spare": 0}], keys
        form.press("Not now")


def test_large_integers_keep_each_digit_and_empty_fields_are_left_out(form: Browser, site: Site) -> None:
    ticks = field(form, "Ticks")
    form.driver.execute_cdp_cmd("Input.insertText", {"text": "18446744073709551615"})  # as a paste does
    assert ticks.get_attribute("value") == "18446744073709551615"
    field(form, "Spare")
    review(form)
    assert "18446744073709551615" in form.find("#in-words").text
    assert signed_values(form, site) == [{"angle": 10, "ticks": 2**64 - 1}]


def test_what_is_no_number_stays_as_typed_and_cannot_be_ordered(form: Browser) -> None:
    for text in ("", "-", ".", "1,000", "0x10", "1e", "five", "1e9999"):
        field(form, "Angle").send_keys("1")
        form.until(lambda: form.all("#allow") or form.all("#order:not([disabled])"), "a way to go on")
        entered = field(form, "Angle")
        for key in text:
            entered.send_keys(key)
        form.find(".field.wrong")
        assert entered.get_attribute("value") == text
        assert not form.find("#order").is_enabled(), text


def test_prices_are_typed_key_by_key(form: Browser) -> None:
    for keys, paid in {"2.5": "2.5 XRT", "0,25": "0.25 XRT", "1.05": "1.05 XRT", "3.": "3 XRT"}.items():
        price = field(form, "You pay")
        for key in keys:
            price.send_keys(key)
        assert price.get_attribute("value") == keys
        review(form)
        assert f"You pay\n{paid}" in form.find("dialog[open]").text
        form.press("Not now")


def test_times_of_messages_are_typed_key_by_key(form: Browser, site: Site) -> None:
    form.press("Add another")
    for key in ("0.25", "1.5"):
        form.until(lambda: len(form.all(".narrow")) == 2, "two times")
        entered = form.all(".narrow")[0 if key == "0.25" else 1]
        entered.send_keys(Keys.CONTROL + "a")
        for one in key:
            entered.send_keys(one)
    review(form)
    found = str(form.find("#objective .name").get_attribute("title"))
    messages = facts(site, f"files/{found}/messages")["messages"]
    assert messages[1]["at"] - messages[0]["at"] == pytest.approx(1.25)


def test_turns_of_a_lighthouse_are_typed_key_by_key(browser: Browser) -> None:
    browser.go()
    browser.connect()
    browser.go("site/lighthouse")
    browser.press("Create a lighthouse")
    length = field(browser, "Length of a turn")
    length.send_keys("2", "5")
    assert length.get_attribute("value") == "25"


def test_another_file_is_what_is_ordered(form: Browser, site: Site, tmp_path: Path) -> None:
    for name, angle in (("one", 10), ("two", 170)):
        (tmp_path / f"{name}.mcap").write_bytes(objective(("/turn", {"angle": angle, "ticks": 1})))
    form.click("#way-file")
    form.find("input[type=file]").send_keys(str(tmp_path / "one.mcap"))
    form.sees("Fits the model")
    form.find("input[type=file]").send_keys(str(tmp_path / "two.mcap"))
    review(form)
    assert "Angle\n170 °" in form.find("#in-words").text
    form.press("Not now")
    form.click("#way-form")
    review(form)
    assert "Angle\n10 °" in form.find("#in-words").text
    assert signed_values(form, site) == [{"angle": 10, "ticks": 0, "spare": 0}]


def test_the_dialog_closes_when_the_account_changes(form: Browser, site: Site) -> None:
    review(form)
    form.driver.execute_script("window.testWallet.emit('accountsChanged', arguments[0])", [site.poor_wallet().address])
    form.sees("Something changed meanwhile")
    assert not form.all("dialog[open]")


def test_a_signature_that_comes_after_the_dialog_was_closed_orders_nothing(form: Browser) -> None:
    wallet = form.wallet
    assert wallet
    review(form)
    answer = wallet.answer

    def late(method: str, params: list[object]) -> object:
        if method == "personal_sign":
            form.driver.execute_script("document.querySelector('dialog[open] .close').click()")
        return answer(method, params)

    wallet.answer = late  # type: ignore[method-assign]
    form.click("#sign")
    form.until(lambda: "personal_sign" in wallet.calls, "the signature")
    form.until(lambda: not form.all("dialog[open]"), "the end of the dialog")
    assert form.driver.execute_script("return localStorage.getItem('aira-orders')") is None


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_the_form_and_the_dialog_can_be_read(form: Browser, pictures: Path, size: tuple[int, int], dark: bool) -> None:
    form.resize(size)
    form.set_dark(dark)
    field(form, "Angle").send_keys("2,5")
    field(form, "Ticks").send_keys("1.5")
    form.find(".field.wrong")
    check(form, pictures / f"numbers-{look(size, dark)}")
    field(form, "Ticks").send_keys("3")
    review(form)
    check(form, pictures / f"words-{look(size, dark)}")


def test_a_topic_with_one_number_has_no_blank_plot(form: Browser, site: Site) -> None:
    cid = put(site, objective(("/one", 5), ("/two", 1), ("/two", 2)))
    form.go(f"file/{cid}")
    form.until(lambda: len(form.all(".track")) == 2, "the topics")
    form.until(lambda: form.all(".plot canvas"), "the plot of two numbers")
    assert len(form.all(".plot")) == 1
