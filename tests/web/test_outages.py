"""Servers, routers, nodes and robots that die while somebody looks at the page; each is a process of its own."""

from __future__ import annotations

import asyncio
import json
import re
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import pytest
from eth_utils.crypto import keccak
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from mesh.chain import DeploymentPlan, write_keyfile
from mesh.dev.development import deploy_market
from tests.support.commands import AIRA, Serving, aira
from tests.support.nodes import Anvil
from tests.support.ports import free_port
from tests.support.routers import Zenohd
from tests.support.web.browser import DESKTOP, PHONE, Browser
from tests.support.web.steps import facts, order, order_locally
from tests.web.conftest import HERE, Site
from tests.web.test_page import NOBODYS_MODEL

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

ROLES = ("provider", "robot", "person")
REFUND_DELAY = 30


@dataclass(frozen=True)
class Fragile:
    """A site whose processes can be killed one by one."""

    site: Site
    node: Anvil
    router: Zenohd
    robot: Serving


@pytest.fixture(scope="module")
def market(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fragile]:
    folder = tmp_path_factory.mktemp("fragile")
    kept = ("--state", str(folder / "chain.json"), "--preserve-historical-states")
    with ExitStack() as stack:
        node, router = stack.enter_context(Anvil(arguments=kept)), stack.enter_context(Zenohd())
        keys = dict(zip(ROLES, node.private_keys, strict=False))
        plan = DeploymentPlan(timeout_blocks=100, refund_delay=REFUND_DELAY)
        deployment = asyncio.run(deploy_market(node.url, node.private_keys, plan=plan)).deployment
        (folder / "password").write_text("a password")
        (folder / "development").mkdir()
        for role, key in keys.items():
            write_keyfile(folder / "development" / f"{role}.json", key, "a password", iterations=1)
        variables = {
            "AIRA_CONNECT": router.endpoint,
            "AIRA_WEB3_HTTP_PROVIDER": node.url,
            "AIRA_ENS_CONTRACT": deployment.ens,
            "AIRA_LIGHTHOUSE_CONTRACT": deployment.lighthouse_name,
            "AIRA_POLL_INTERVAL": "0.2",
            "AIRA_DATA_DIR": str(folder),
            "AIRA_KEYFILE_PASSWORD_FILE": str(folder / "password"),
        }

        def serve(name: str, *command: object, says: str) -> Serving:
            own = {"AIRA_KEYFILE": f"{folder}/development/{name}.json", "AIRA_DATA_DIR": str(folder / name)}
            own |= {"AIRA_OPEN_SERVICES": "true", "ROBOT_PRICE": "5 XRT"} if name == "robot" else {}
            words = [str(word) for word in command]
            return stack.enter_context(Serving(*words, says=says, variables=variables | own))

        serve("provider", *AIRA, "provider", says="provider")
        made = aira("model", "new", HERE / "model.json", "--out", folder / "model.json", "--json")
        model = json.loads(made.stdout)["cid"]
        robot = serve("robot", sys.executable, HERE / "robot.py", folder / "model.json", says="robot 0x")
        site = Site("", model, "", node.url, keys["person"], variables, folder)
        url = stack.enter_context(site.page())
        yield Fragile(Site(url, model, "", node.url, keys["person"], variables, folder), node, router, robot)


@pytest.fixture
def fragile(market: Fragile) -> Iterator[Fragile]:
    """The market; afterwards all of it runs again, also if the test failed."""
    yield market
    for server in (market.node, market.router, market.robot):
        if server.is_running:
            server.resume()
        else:
            server.stop()
            server.start()


@pytest.mark.full
def test_a_job_goes_on_when_router_and_node_come_back(fragile: Fragile) -> None:
    with Browser(fragile.site.url, fragile.site.wallet()) as browser:
        order(browser, fragile.site, seconds=10)
        fragile.router.kill()
        browser.sees("The server has lost the router")
        fragile.router.start()
        browser.sees("Live")
        fragile.node.stop()
        browser.sees("The server has lost the chain")
        fragile.node.start()
        browser.sees("Live")
        browser.sees("the robot was paid")
        order(browser, fragile.site)
        browser.sees("the robot was paid")


def test_an_owner_is_alerted_when_a_robot_does_not_answer(fragile: Fragile) -> None:
    with Browser(fragile.site.url) as browser:
        browser.go("site")
        browser.until(lambda: browser.all("td .dot.good") and "No answer:" not in browser.text(), "the robot's health")
        fragile.robot.pause()
        browser.sees("No answer:")
        fragile.robot.resume()
        browser.until(lambda: browser.all("td .dot.good") and "No answer:" not in browser.text(), "the robot's health")


@pytest.mark.sample("account")
@pytest.mark.parametrize("account", ["wallet", "local"])
def test_the_price_of_a_job_that_nobody_finishes_is_taken_back(fragile: Fragile, account: str) -> None:
    site = fragile.site
    with ExitStack() as stack:
        url = stack.enter_context(site.page(keyfile=True)) if account == "local" else site.url
        browser = stack.enter_context(Browser(url, site.wallet()))
        if account == "local":
            order_locally(browser, site, seconds=120)
        else:  # allowed by a transaction: what is ordered by a permit the provider takes back
            market = facts(site, "market")
            allowed = "0x095ea7b3" + market["factory"][2:].lower().zfill(64) + f"{5 * 10**9:064x}"
            sent = {"from": site.wallet().address, "to": market["xrt"]["address"], "data": allowed}
            site.wallet().rpc("eth_sendTransaction", sent)
            order(browser, site, seconds=120)
        browser.sees("Robot ready")
        fragile.robot.kill()
        browser.sees("If nothing comes, you can take 5 XRT back in about")
        assert not browser.all("#refund")
        site.wallet().rpc("anvil_mine", hex(REFUND_DELAY + 1))
        if account == "wallet":  # the server takes its account's money back by itself
            browser.click("#refund")
        browser.sees("The contract was called off. The price went back.")


class State(NamedTuple):
    """What somebody looks at when something fails."""

    show: Callable[[Browser, Site], None]
    holds: str
    """The elements (CSS) whose texts and values must be there afterwards as before."""
    log: str = ""
    """The elements that have at least the numbers of before."""


def see_robots(browser: Browser, _site: Site) -> None:
    browser.go()
    browser.sees("available")


def see_a_finished_job(browser: Browser, site: Site) -> None:
    order_locally(browser, site, seconds=0.5)
    browser.sees("the robot was paid")
    browser.until(lambda: browser.all("#checks .badge.good"), "the checks")


def see_a_running_job(browser: Browser, site: Site) -> None:
    order_locally(browser, site, seconds=300)
    browser.sees("Playback began")


def retype(browser: Browser, label: str, text: str) -> None:
    """Empty a field, and type into it key by key."""
    browser.type(label, Keys.BACKSPACE)
    for key in text:
        browser.keys(key)


def see_quotes(browser: Browser, site: Site) -> None:
    browser.go(f"order/model/{site.model}")
    retype(browser, "Duration", "12.5")
    browser.find(".quote [value]:checked")
    browser.find("#order:not([disabled])")


def see_a_waiting_order(browser: Browser, site: Site) -> None:
    liability = facts(site, "liabilities")["liabilities"][0]
    browser.go(f"order/model/{NOBODYS_MODEL}//{liability['objective']}")
    browser.find(".chosen-objective")
    browser.click("#order:not([disabled])")
    browser.click("#sign")
    browser.sees("Your order is in the market")


def see_ones_own_robot(browser: Browser, site: Site) -> None:
    browser.go(f"robot/{facts(site, 'liabilities')['liabilities'][0]['promisor']}")
    retype(browser, "Price of a job", "3.25")
    browser.find("#set-price:not([disabled])")


NEW_LIABILITY: Final = "0x" + keccak(text="NewLiability(address)").hex()
STATES: Final = {
    "robots": State(see_robots, ".robot h2, .robot .does, .robot .foot"),
    "done": State(
        see_a_finished_job, "h1, .lead, .timeline li:has(.name) strong, .track h3, .track .foot, #checks .badge.bad"
    ),
    "running": State(
        see_a_running_job, "h1, .steps .active, .lead, .timeline strong, #stop", ".track:has(.path) .foot"
    ),
    "waiting": State(see_a_waiting_order, "h1, .steps .active, .lead, .facts code, #withdraw"),
    "form": State(see_quotes, ".form input, .form select, .quote, .total"),
    "owner": State(see_ones_own_robot, "h1, .owner input, .owner .lead, .owner .bars, .jobs"),
}
"""In this order: the robot has one job at a time."""

SEEN: Final = """
const isField = (one) => one.matches("input, select");
const read = (one) => isField(one) ? `${one.value} ${one.checked ?? ""}` : one.innerText ?? one.ariaLabel;
return arguments[0] ? [...document.querySelectorAll(arguments[0])].map(read) : [];
"""


@dataclass(frozen=True)
class Tabs:
    """A tab for each state, at a server of their own."""

    browser: Browser
    site: Site
    server: Serving
    handles: dict[str, str]

    def each(self) -> Iterator[str]:
        """The states, each while its tab is in front."""
        for name, handle in self.handles.items():
            self.browser.driver.switch_to.window(handle)
            yield name

    def seen(self, name: str) -> tuple[list[str], list[int]]:
        """What of the state stays, and the numbers that may only grow."""
        holds, log = (self.browser.driver.execute_script(SEEN, css) for css in STATES[name][1:])
        return holds, [int(re.sub(r"\D", "", text)) for text in log]

    def settled(self, name: str) -> tuple[list[str], list[int]]:
        """What is seen of the state once it has stayed the same for a second: some of it comes later."""
        since, seen = time.monotonic(), self.seen(name)[0]

        def has_stayed() -> bool:
            nonlocal since, seen
            now = self.seen(name)[0]
            if now != seen:
                since, seen = time.monotonic(), now
            return time.monotonic() - since > 1

        self.browser.until(has_stayed, f"{name} to stay as it is")
        return self.seen(name)

    def contracts(self) -> int:
        """How many there are on the chain."""
        of_factory = {"address": facts(self.site, "market")["factory"], "fromBlock": "0x0"}
        return len(self.site.wallet().rpc("eth_getLogs", of_factory | {"topics": [NEW_LIABILITY]}))

    def check(self, name: str, before: tuple[list[str], list[int]]) -> None:
        """Wait until the page is as before, or further; fail if it does not become so."""

        def is_as_before() -> bool:
            holds, log = self.seen(name)
            return holds == before[0] and log >= before[1]

        with suppress(AssertionError):
            self.browser.until(is_as_before)
        assert self.seen(name)[0] == before[0], f"{name}: {self.browser.text()}"
        assert is_as_before(), f"{name}: {before[1]}, now {self.seen(name)[1]}"


@pytest.fixture(scope="module")
def tabs(market: Fragile) -> Iterator[Tabs]:
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    with market.site.page_server(keyfile=True, port=port) as server, Browser(url) as browser:
        tabs = Tabs(browser, replace(market.site, url=url), server, {})
        for name, state in STATES.items():
            browser.driver.switch_to.new_window("tab")
            browser.resize(DESKTOP)
            state.show(browser, tabs.site)
            tabs.handles[name] = browser.driver.current_window_handle
        yield tabs


OUTAGES: Final = {"none": "Live", "router": "The server has lost the router", "server": "Connection lost"}


@pytest.mark.parametrize("outage", OUTAGES)
def test_what_is_seen_outlives_a_reload_and(fragile: Fragile, tabs: Tabs, pictures: Path, outage: str) -> None:
    browser, contracts = tabs.browser, tabs.contracts()
    before = {name: tabs.settled(name) for name in tabs.each()}
    lost = {"router": fragile.router, "server": tabs.server}.get(outage)
    if lost is not None:
        lost.kill()
        for name in tabs.each():
            browser.sees(OUTAGES[outage])
            for look, size in (("desktop", DESKTOP), ("phone", PHONE)):
                browser.resize(size)
                browser.picture(pictures / f"lost-{outage}-{name}-{look}.png")
            browser.resize(DESKTOP)
            assert tabs.seen(name)[0] == before[name][0], name
        lost.start()
        for name in tabs.each():
            browser.sees("Live")
            tabs.check(name, before[name])
    for name in tabs.each():
        assert browser.errors() == []
        browser.driver.refresh()
        tabs.check(name, (before[name][0], []))
        assert browser.errors() == []
    assert tabs.contracts() == contracts


class Act(NamedTuple):
    """What somebody does in one of two tabs."""

    clicks: tuple[str, ...]
    does: str
    """The words then in this tab, …"""
    shows: str
    """… and in the other one, which was at the same address."""
    contracts: int = 0
    """How many are made."""


ACTS: Final = {
    "waiting": Act(("#withdraw",), "You withdrew this order", "You withdrew this order"),
    "running": Act(
        ("#stop", "#stop-now"), "You stopped it. The price went back.", "You stopped it. The price went back."
    ),
    "owner": Act(("#set-price:not([disabled])",), "Saved.", "3.25 XRT"),
    "form": Act(("#order:not([disabled])", "#sign"), "Playback began", "Robot 0x", 1),
}


@pytest.mark.parametrize("state", ACTS)
def test_what_is_done_in_one_tab_is_seen_in_another(tabs: Tabs, state: str) -> None:
    browser, act, before = tabs.browser, ACTS[state], tabs.contracts()
    browser.driver.switch_to.window(tabs.handles[state])
    address = browser.driver.current_url
    browser.driver.switch_to.new_window("tab")
    other = browser.driver.current_window_handle
    browser.driver.get(address)
    browser.find(act.clicks[0].partition(":")[0])
    browser.driver.switch_to.window(tabs.handles[state])
    for css in act.clicks[:-1]:
        browser.click(css)
    ActionChains(browser.driver).double_click(browser.find(act.clicks[-1])).perform()
    browser.sees(act.does)
    assert browser.errors() == []
    browser.driver.switch_to.window(other)
    browser.sees(act.shows)
    assert browser.driver.current_url == address
    assert browser.errors() == []
    browser.driver.close()
    assert tabs.contracts() == before + act.contracts
