"""Routers, nodes and robots that die in the middle of a job; each is a process of its own."""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from mesh.chain import DeploymentPlan, write_keyfile
from mesh.dev.development import deploy_market
from tests.support.commands import AIRA, Serving, aira
from tests.support.nodes import Anvil
from tests.support.routers import Zenohd
from tests.web.browser import Browser
from tests.web.conftest import HERE, Site
from tests.web.steps import fill_in, order

if TYPE_CHECKING:
    from collections.abc import Iterator

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
            keyfile = variables | {"AIRA_KEYFILE": f"{folder}/development/{name}.json"}
            words = [str(word) for word in command]
            return stack.enter_context(
                Serving(*words, says=says, variables=keyfile | {"AIRA_DATA_DIR": str(folder / name)})
            )

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
            browser.go()
            browser.find("#account")
            fill_in(browser, site, seconds=120)
            browser.click("#order:not([disabled])")
            browser.click("#sign")
            browser.until(lambda: "#/job/" in browser.driver.current_url, "the job")
        else:
            order(browser, site, seconds=120)
        browser.sees("Robot ready")
        fragile.robot.kill()
        browser.sees("If nothing comes, you can take 5 XRT back in about")
        assert not browser.all("#refund")
        site.wallet().rpc("anvil_mine", hex(REFUND_DELAY + 1))
        browser.click("#refund")
        browser.sees("The contract was called off. The price went back.")
