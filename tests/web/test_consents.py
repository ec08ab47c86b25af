"""Orders of programs that wait for a person's yes: what the operator sees on the page, and what the program is told."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from mcp_types.version import LATEST_MODERN_VERSION

from tests.support.commands import AIRA, Serving
from tests.support.mcp.clients import stdio_client
from tests.support.mcp.world import content, ended
from tests.support.signer.signers import short_folder
from tests.support.web.browser import Browser
from tests.support.web.steps import facts

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mcp import Client

    from tests.web.conftest import Site

OPERATORS = "a token of operators 456"
POLICY = """\
[budget]
per_job = "5 XRT"
per_hour = "20 XRT"
per_day = "50 XRT"
jobs_at_a_time = 2

[consent]
above = "1 XRT"
valid = "10 min"

[[allow]]
models = ["{model}"]
robots = ["*"]
[allow.topics."/drive"]
metres = {{ min = 0.5, max = 10 }}
seconds = {{ min = 0, max = 5 }}
direction = {{ one_of = ["left", "right"] }}
"""


@pytest.fixture
def signer(site: Site) -> Iterator[Path]:
    """The folder of the sockets of a signer with the person's key, which is a process of its own."""
    for folder in short_folder():
        policy = folder / "policy.toml"
        policy.write_text(POLICY.format(model=site.model))
        policy.chmod(0o600)
        keyfile = {"AIRA_DATA_DIR": str(folder), "AIRA_KEYFILE": f"{site.folder}/development/person.json"}
        with Serving(*AIRA, "signer", "--policy", policy, says="signer  ", variables=site.variables | keyfile):
            yield next(folder.rglob("door.sock")).parent


class Program:
    """A program that hires robots by `aira mcp`, which it starts for each call."""

    def __init__(self, signer: Path) -> None:
        self._arguments = ("--socket", str(signer / "door.sock"), "--data-dir", str(signer.parent / "door"))

    def call(self, tool: str, **arguments: Any) -> dict[str, Any]:
        async def work(client: Client) -> dict[str, Any]:
            return content(await client.call_tool(tool, arguments))

        return self._do(work)

    def end(self, job: dict[str, Any]) -> dict[str, Any]:
        """The job once it is over."""
        return self._do(lambda client: ended(client, job))

    def _do(self, work: Any) -> dict[str, Any]:
        async def main() -> dict[str, Any]:
            async with asyncio.timeout(120), stdio_client(*self._arguments, version=LATEST_MODERN_VERSION) as client:
                found: dict[str, Any] = await work(client)
                return found

        return asyncio.run(main())


def order(site: Site, robot: str, key: str, *, direction: str) -> dict[str, Any]:
    messages = [{"topic": "/drive", "value": {"metres": 1.5, "seconds": 1, "direction": direction}}]
    note = "Say <b>yes</b> to this one"
    whole = {"model": site.model, "robot": robot, "cost": "2 XRT", "idempotency_key": key, "note": note}
    return whole | {"messages": messages}


def test_an_operator_allows_one_order_of_a_program_and_denies_another(site: Site, signer: Path, tmp_path: Path) -> None:
    program = Program(signer)
    (robot,) = (one["address"] for one in program.call("find_robots", model=site.model)["robots"])
    left = program.call("order", **order(site, robot, "one", direction="left"))
    right = program.call("order", **order(site, robot, "two", direction="right"))
    assert [left["state"], right["state"]] == ["needs-consent", "needs-consent"]
    (tmp_path / "operators").write_text(OPERATORS)
    options = ("--operator-token-file", str(tmp_path / "operators"), "--signer", str(signer / "owner.sock"))
    with site.page(*options) as url, Browser(url) as browser:
        browser.go("site")
        browser.sees("Only operators can see and allow them")
        assert not browser.all(".consent"), "whoever did not log in sees no order of a program"
        browser.press("Only operators can see and allow them")
        browser.type("Token", OPERATORS)
        browser.click("details[open] form button")
        browser.until(lambda: len(browser.all(".consent")) == 2, "the two orders")
        assert browser.violations() == []
        consents = {one.text for one in browser.all(".consent")}
        (shown,) = (text for text in consents if '"left"' in text)
        for words in (
            "2 XRT",
            f"{robot[:6]}…{robot[-4:]}",
            '/drive {"metres":1.5,"seconds":1,"direction":"left"}',
            left["consent"]["why"],
        ):
            assert words in shown, shown
        assert "Say <b>yes</b> to this one" in shown, "what a program says is no part of the page"
        assert program.call("job", job_id=left["job_id"])["contract"] == "", "nothing is ordered before the yes"

        browser.click(f"#deny-{right['consent']['id']}")
        browser.sees("Denied. Nothing was signed.")
        browser.until(lambda: len(browser.all(".consent")) == 1, "the other order alone")
        browser.click(f"#allow-{left['consent']['id']}")
        browser.sees("Allowed. It is ordered now.")
        browser.until(lambda: not browser.all(".consent"), "no orders that wait")

        done = program.end(left)
        assert (done["state"], done["cost"]["text"]) == ("done", "2 XRT"), done["error"]
        assert facts(site, f"liabilities/{done['contract']}")["liability"]["model"] == site.model
        browser.go(f"job/{done['contract']}")
        browser.sees("the robot was paid")
        denied = program.call("job", job_id=right["job_id"])
        assert (denied["state"], denied["contract"]) == ("denied", "")
        again = program.call("order", **order(site, robot, "two", direction="right"))
        assert (again["job_id"], again["state"]) == (right["job_id"], "denied"), "asking again does not help"
