"""Operators, owners and providers: what each sees and may do, and what strangers may not."""

from __future__ import annotations

import secrets
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from schemas.model import parse_description
from tests.support.web.browser import Browser
from tests.support.web.steps import anybody, check, facts, fill_in, order, sign
from tests.web.conftest import opened
from tests.web.test_order_form import put

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.web.browser import Wallet
    from tests.web.conftest import Site

NUMBERS = Path(__file__).parent / "number_model.json"
PEOPLE, OPERATORS = "a token of people 123", "a token of operators 456"
FORBIDDEN = """
const [robot, liability, done] = arguments;
fetch(`/api/v1/agents/${robot}/finish`, {
  method: "POST",
  headers: { "Content-Type": "application/json", "X-Aira-Request": "1" },
  body: JSON.stringify({ liability }),
}).then(async (answer) => done([answer.status, (await answer.json()).error.code]));
"""


@contextmanager
def guarded(site: Site, folder: Path) -> Iterator[str]:
    """A page where people and operators log in."""
    (folder / "people").write_text(PEOPLE)
    (folder / "operators").write_text(OPERATORS)
    with site.page("--token-file", str(folder / "people"), "--operator-token-file", str(folder / "operators")) as url:
        yield url


def log_in(browser: Browser, token: str) -> None:
    browser.go()
    browser.type("Token", token)
    browser.press("Log in")
    browser.sees("What should be done?")


def test_operators_finish_a_job_and_strangers_may_not(site: Site, tmp_path: Path) -> None:
    with guarded(site, tmp_path) as url, Browser(url, site.wallet()) as person, Browser(url) as operator:
        person.go()
        person.type("Token", "not the token at all")
        person.press("Log in")
        person.sees("this is not the token")
        assert person.violations() == []
        log_in(person, PEOPLE)
        log_in(operator, OPERATORS)
        person.connect()
        fill_in(person, site, seconds=120)
        job = sign(person)
        person.sees("Robot ready")
        robot = facts(site, f"liabilities/{job}")["liability"]["promisor"]
        assert not person.all("#finish")
        assert person.driver.execute_async_script(FORBIDDEN, robot, job) == [403, "operators-only"]
        operator.go(f"job/{job}")
        operator.click("#finish")
        operator.sees("Done: finish")
        person.sees("the robot was paid")


def test_an_owner_sees_health_money_jobs_and_logs(browser: Browser, site: Site) -> None:
    address = order(browser, site)
    browser.sees("the robot was paid")
    browser.go("jobs")
    browser.until(lambda: "ended (0)" not in browser.find("main select").text, "jobs that have ended")
    browser.find("main select").send_keys("ended")
    browser.until(lambda: browser.all(f"li[title='{address}']"), "the job among those")
    browser.go("site")
    robot = facts(site, f"liabilities/{address}")["liability"]["promisor"]
    row = f"//tr[.//*[@title='{robot}']]"
    browser.until(lambda: "done" in browser.driver.find_element("xpath", row).text, "the robot's record")
    browser.click(f"tr:has([title='{robot}']) button[aria-expanded]")
    browser.until(lambda: "Earned" in browser.find(".panel").text, "what the robot earned")
    browser.until(lambda: browser.all(f".panel [title='{address}']"), "the job")
    provider = facts(site, "lighthouse")["providers"][0]["address"]
    browser.click(f"tr:has([title='{provider}']) button[aria-expanded]")
    browser.click("#log summary")
    browser.until(lambda: "contract-created" in browser.find("#log").text, "an event of the provider's log")
    assert browser.violations() == []


def order_terms(browser: Browser, site: Site, *, is_private: bool) -> None:
    """With the wallet, come to the dialog that shows the order before it is signed: for one robot, or for anybody."""
    browser.go()
    browser.connect()
    fill_in(browser, site)
    if not is_private:
        anybody(browser)
    browser.click("#order:not([disabled])")


@pytest.mark.parametrize("is_private", [True, False], ids=["one robot", "anybody"])
def test_a_person_without_ether_orders_and_the_job_is_paid(site: Site, pictures: Path, is_private: bool) -> None:
    wallet, rich, market = site.poor_wallet(), site.wallet(), facts(site, "market")
    first = int(rich.rpc("eth_blockNumber"), 16)
    rich.give(wallet.address, token=market["token"]["address"], units=10**10)
    with Browser(site.url, wallet) as browser:
        order_terms(browser, site, is_private=is_private)
        price = browser.find("dialog[open] strong").text
        words = browser.find("#permit").text
        assert f"lets the market's contract take up to {price} from your account until " in words
        assert market["factory"] in words
        check(browser, pictures / "permit.png")
        wallet.rejects.add("eth_signTypedData_v4")
        browser.click("#sign")
        browser.sees("You rejected it in the wallet")
        wallet.rejects.clear()
        browser.click("#sign")
        browser.sees("the robot was paid")
    (job,) = facts(site, f"accounts/{wallet.address}")["liabilities"]
    assert job["state"] == "paid"
    domain, permit = (wallet.typed_data[-1][part] for part in ("domain", "message"))
    assert (domain["verifyingContract"], domain["chainId"]) == (market["token"]["address"], market["chainId"])
    assert (permit["spender"], permit["value"]) == (market["factory"], job["cost"])
    assert not {"eth_sendTransaction", "eth_sendRawTransaction"} & set(wallet.calls)
    account = facts(site, f"accounts/{wallet.address}")
    assert (account["transactions"], int(account["token"]["balance"])) == (0, 10**10 - int(job["cost"]))
    blocks = range(first, int(rich.rpc("eth_blockNumber"), 16) + 1)
    assert {rich.rpc("eth_getBalance", wallet.address, hex(block)) for block in blocks} == {"0x0"}


def test_a_person_without_ether_agrees_to_the_fee_that_the_provider_wants_by_signing(
    tmp_path: Path, pictures: Path
) -> None:
    cost, fee = 100_000, 319_000 - 100_000 + 16_300  # wn: what its gas is worth, and that of the fee itself
    with opened(tmp_path, "--free-contracts", "0") as site:
        wallet, rich, token = site.poor_wallet(), site.wallet(), facts(site, "market")["token"]["address"]
        rich.give(wallet.address, token=token, units=cost + fee - 1)
        with Browser(site.url, wallet) as browser:
            browser.go()
            browser.connect()
            fill_in(browser, site)
            anybody(browser)
            browser.type("You pay", "0.0001")
            browser.click("#order:not([disabled])")
            browser.sees("This account has 0.000335299 XRT, and the order needs 0.0003353 XRT.")
            rich.give(wallet.address, token=token, units=1)
            browser.click("#order:not([disabled])")
            assert browser.find("#in-all").text == "0.0003353 XRT"
            browser.sees("Provider's fee for sending your order\n0.0002353 XRT")
            assert "take up to 0.0003353 XRT from your account" in browser.find("#permit").text
            check(browser, pictures / "permit-fee.png")
            browser.click("#sign")
            browser.sees("the robot was paid")
        account = facts(site, f"accounts/{wallet.address}")
        (job,) = account["liabilities"]
        assert (job["state"], job["cost"], job["validatorFee"]) == ("paid", str(cost), str(fee))
        assert (account["token"]["balance"], account["eth"], account["transactions"]) == ("0", "0", 0)


def use_permit(wallet: Wallet, rich: Wallet, market: dict[str, Any]) -> None:
    """Let the token take another permit of the wallet's account, as that of an order from elsewhere is taken."""
    token, owner, spender = market["token"]["address"], wallet.address, market["factory"]
    nonce = int(rich.rpc("eth_call", {"to": token, "data": f"0x7ecebe00{int(owner, 16):064x}"}, "latest"), 16)
    domain = {"name": "Robonomics", "version": "1", "chainId": market["chainId"], "verifyingContract": token}
    fields = {"owner": "address", "spender": "address", "value": "uint256", "nonce": "uint256", "deadline": "uint256"}
    types = {"Permit": [{"name": name, "type": kind} for name, kind in fields.items()]}
    message = {"owner": owner, "spender": spender, "value": 0, "nonce": nonce, "deadline": 2**40}
    signed = wallet.account.sign_typed_data(domain, types, message)
    words = (int(owner, 16), int(spender, 16), 0, 2**40, signed.v, signed.r, signed.s)
    rich.transact({"to": token, "data": "0xd505accf" + "".join(f"{word:064x}" for word in words)})


@pytest.mark.parametrize("is_private", [True, False], ids=["one robot", "anybody"])
def test_a_permit_that_another_order_used_before_the_signature_is_signed_anew(site: Site, is_private: bool) -> None:
    wallet, rich = site.poor_wallet(), site.wallet()
    rich.give(wallet.address, token=facts(site, "market")["token"]["address"], units=10**10)
    with Browser(site.url, wallet) as browser:
        order_terms(browser, site, is_private=is_private)
        browser.find("#permit")
        use_permit(wallet, rich, facts(site, "market"))
        browser.click("#sign")
        browser.sees("Another order of yours has used this permit. Sign a new one.")
        browser.click("#sign")
        browser.sees("the robot was paid")
    assert [one["message"]["nonce"] for one in wallet.typed_data[-2:]] == ["0", "1"]


def test_a_permit_of_an_order_that_waits_is_signed_again_if_another_order_used_it(site: Site) -> None:
    wallet, rich, token = site.poor_wallet(), site.wallet(), facts(site, "market")["token"]["address"]
    rich.give(wallet.address, token=token, units=10**10)
    told = "{kind: 'rejected', agent: body.order.signer, code: 'ERC20InsufficientAllowance', detail: '', at: 1}"
    model = put(site, parse_description(NUMBERS.read_bytes()).encode())  # no robot has it
    with Browser(site.url, wallet) as browser:
        browser.lie(r"orders\/[0-9a-f]{64}$", f"body.statements.push({told})")
        browser.go()
        browser.connect()
        browser.go(f"order/model/{model}")
        browser.find(".form input")
        browser.type("You pay", "2")
        browser.click("#order:not([disabled])")
        price = browser.find("dialog[open] strong").text
        browser.click("#sign")
        browser.sees("Another order of yours has used the permit of this one.")
        use_permit(wallet, rich, facts(site, "market"))
        assert f"take up to {price} from your account until " in browser.find("#another-permit").text
        browser.click("#sign-permit")
        browser.sees("Another order of yours has used this permit. Sign a new one.")
        browser.click("#sign-permit")
        browser.sees("The new permit is on its way to the providers.")
    first, second = wallet.typed_data[0]["message"], wallet.typed_data[-1]["message"]
    assert (second["nonce"], second["value"]) == ("1", first["value"])


NO_PERMITS = r"accounts\/0x\w+$", "body.permits = false"
"""A lie, after which the page takes the providers for some that take no permits."""


def test_without_ether_for_gas_the_page_says_what_to_do(site: Site) -> None:
    wallet, rich = site.poor_wallet(), site.wallet()
    rich.give(wallet.address, token=facts(site, "market")["token"]["address"], units=10**10)
    with Browser(site.url, wallet) as browser:
        browser.lie(*NO_PERMITS)
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.sees("which costs gas, and this account has 0 ETH")
        rich.give(wallet.address, wei=10**17)
        browser.press("Check again")
        browser.click("#allow")
        browser.sees("The market may take")
        browser.find("#order:not([disabled])")


def test_an_allowance_that_the_wallet_refuses_can_be_given_later(site: Site) -> None:
    wallet, rich = site.poor_wallet(), site.wallet()
    rich.give(wallet.address, token=facts(site, "market")["token"]["address"], units=10**10)
    rich.give(wallet.address, wei=10**17)
    wallet.rejects.add("eth_sendTransaction")
    with Browser(site.url, wallet) as browser:
        browser.lie(*NO_PERMITS)
        browser.go()
        browser.connect()
        fill_in(browser, site)
        browser.click("#allow")
        browser.sees("You rejected it in the wallet")
        wallet.rejects.clear()
        browser.click("#allow")
        browser.click("#order:not([disabled])")
        browser.find("#hash")


@pytest.mark.full
def test_a_provider_creates_a_lighthouse_stakes_and_withdraws(browser: Browser, site: Site) -> None:
    browser.go()
    browser.connect()
    browser.go("site/lighthouse")
    browser.sees("Your stake")
    browser.press("Create a lighthouse")
    name = f"tower{secrets.token_hex(3)}"
    browser.type("Name", name)
    browser.driver.find_elements("xpath", "//button[normalize-space(.)='Create a lighthouse']")[-1].click()
    browser.sees(f"The lighthouse {name} is created")
    assert browser.wallet
    browser.type("XRT", "2")
    browser.click("#stake")
    browser.sees("The stake is in the lighthouse")
    own = f"//*[@aria-label='Providers']//tr[.//*[@title='{browser.wallet.address}']]"
    browser.until(lambda: "2 XRT" in browser.driver.find_element("xpath", own).text, "the stake in the list")
    browser.click("#unstake")
    browser.sees("The stake is back in your account")
    browser.until(lambda: not browser.driver.find_elements("xpath", own), "the end of the stake")
