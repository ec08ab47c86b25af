"""Choosing a robot and stopping it, as a person types it: `aira quotes`, `--robot`, `--max-cost`, Ctrl-C twice."""

from __future__ import annotations

import asyncio
import json
import os
import re
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Declined
from mesh.agent.agent import Agent
from schemas.model import ModelDescription, ModelTopic, ValueSchema
from tests.support.cli.site import QUICK_RESEND, Site
from tests.support.commands import AIRA, SECONDS, Serving, aira, environment, refused
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.handlers import Job
    from schemas import Demand, Verified
    from schemas.rpc import QuoteRequest
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

ROLES = {"Lift 1": "robot", "Lift 2": "rival"}
SPEAKER = ModelDescription(
    title="Speaker", objective=(ModelTopic(topic="/say", value=ValueSchema(type="string")),), price="9 wn", seconds=5
)


class Lifts:
    """Two robots of one model, and a person at a command line: `async with lifts.at_work(…)`."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.model = site.folder / "speaker.json"
        self.model.write_bytes(SPEAKER.encode())
        self.began = asyncio.Event()
        self.may_end = asyncio.Event()

    def address(self, name: str) -> str:
        return self.site.address(ROLES[name])

    def short(self, name: str) -> str:
        """A robot as people read it."""
        return f"{name} ({self.address(name)[:6]}…{self.address(name)[-4:]})"

    def robot(self, name: str, price: str) -> Agent:
        """A robot that does jobs for a price; with a word for a price it declines them all with this code."""
        role, is_willing = ROLES[name], price[0].isdigit()
        settings = self.site.settings(role, name=name, data_dir=str(self.site.folder / role))
        robot = Agent(self.model, settings=settings, account=self.site.accounts[role], resend=QUICK_RESEND)

        @robot.on_quote
        async def quote(request: QuoteRequest) -> str:
            if not is_willing:
                raise Declined(price, "the lift is out for repair")
            return price

        @robot.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            if not is_willing:
                raise Declined(price, "the lift is out for repair")
            await robot.offer(demand)

        @robot.on("/say")
        async def say(job: Job, word: str) -> None:
            self.began.set()
            await self.may_end.wait()

        return robot

    @asynccontextmanager
    async def at_work(self, *prices: str) -> AsyncIterator[None]:
        """`Lift 1` and `Lift 2` at these prices."""
        first, second = (self.robot(name, price) for name, price in zip(ROLES, prices, strict=True))
        async with first, second:
            yield

    def words(self, command: str, *options: str, played: Path | None = None) -> tuple[str, ...]:
        played = played or self.site.job("up")
        return (command, "--model", str(self.model), "--objective", str(played), *options)

    async def call(self, command: str, *options: str, played: Path | None = None) -> Any:
        """Run `aira quotes` or `aira demand` to its end."""
        words = self.words(command, *options, played=played)
        return await asyncio.to_thread(aira, *words, **self.site.variables("person"))

    def demand(self, *options: str, says: str) -> Serving:
        """`aira demand`, not yet started."""
        return Serving(*AIRA, *self.words("demand", *options), says=says, variables=self.site.variables("person"))


@pytest.fixture
async def lifts(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Lifts:
    return Lifts(await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path))


async def test_quotes_list_the_cheapest_first_and_refusals_with_their_reasons_below(lifts: Lifts) -> None:
    unfit = lifts.site.folder / "unfit.mcap"
    unfit.write_bytes(objective(("/fly", "up")))
    silent = await lifts.call("quotes")
    assert silent.stdout == "no robot of this model answers\n"
    async with lifts.at_work("7wn", "out-of-order"):
        shown = await lifts.call("quotes")
        head, offer, refusal = shown.stdout.splitlines()
        assert head.split() == ["cost", "begins", "takes", "name", "address"]
        assert offer.split() == ["0.000000007", "XRT", "now", "5", "s", "Lift", "1", lifts.address("Lift 1")]
        assert refusal == f"{lifts.short('Lift 2')} declines: the lift is out for repair (out-of-order)"
        given = json.loads((await lifts.call("quotes", "--json")).stdout)["quotes"]
        assert [(one["name"], one["cost"], one.get("code", "")) for one in given] == [
            ("Lift 1", "7", ""),
            ("Lift 2", "0", "out-of-order"),
        ]
        refused(await lifts.call("quotes", played=unfit), "objective-unfit")
    async with lifts.robot("Lift 1", "7wn"):
        (_, offer) = (await lifts.call("quotes")).stdout.splitlines()
        assert offer.endswith(f"Lift 1  {lifts.address('Lift 1')}")


async def test_a_robot_is_hired_by_its_name_and_a_message_without_any_file(lifts: Lifts) -> None:
    lifts.may_end.set()
    person = lifts.site.variables("person")

    async def typed(*words: str) -> Any:
        return await asyncio.to_thread(aira, *words, **person)

    async with lifts.site.provider(), lifts.at_work("9wn", "4wn"):
        message = ("--message", '/say "two words"')
        quotes = await typed("quotes", "--model", str(lifts.model), *message)
        assert [line.split()[0] for line in quotes.stdout.splitlines()[1:]] == ["0.000000004", "0.000000009"]
        done = await typed("demand", "--robot", "lift 2", "--cost", "4wn", *message)
        assert f" with {lifts.short('Lift 2')}\n" in done.stdout
        shown = await typed("objective", "cat", done.stdout.split("recording ")[1].strip())
        assert shown.stdout.split()[2:] == ["/say", "(objective)", '"two', 'words"']
        unfit = await typed("demand", "--robot", "lift 2", "--message", "/say 5")
        assert unfit.returncode == 2
        assert unfit.stderr.endswith("value must be a string, not 5 [objective-unfit]\n")
        refused(await typed("demand", "--robot", "lift 2", "--message", "/say five"), "invalid-line")
        refused(await typed("demand", "--robot", "lift 3", *message), "robot-unknown")
        refused(await typed("demand", "--robot", "cheapest", *message), "invalid-options")
        refused(await typed("demand", "--robot", "lift 2"), "invalid-options")
        refused(await lifts.call("demand", *message), "invalid-options")


async def test_the_cheapest_robot_is_hired_and_the_order_names_it_with_its_price(lifts: Lifts) -> None:
    lifts.may_end.set()
    async with lifts.site.provider(), lifts.at_work("9wn", "4wn"):
        dear = await lifts.call("demand", "--robot", "cheapest", "--max-cost", "3wn")
        hint = dear.stderr.splitlines()[-1]
        assert f"{lifts.short('Lift 2')} wants 0.000000004 XRT; {lifts.short('Lift 1')} wants" in dear.stderr
        assert (dear.returncode, "--max-cost" in hint, "if you stop" in dear.stdout) == (1, True, False)
        done = await lifts.call("demand", "--robot", "cheapest", "--max-cost", "8wn")
        assert done.returncode == 0, done.stderr
        lines = done.stdout.splitlines()
        posted = next(number for number, line in enumerate(lines) if line.startswith("posted "))
        terms = f"0.000000004 XRT for {lifts.short('Lift 2')}"
        assert re.fullmatch(rf"posted [0-9a-f]{{64}}, {re.escape(terms)}, valid until block [\d,]+", lines[posted])
        assert lines[posted + 1] == "if you stop the job after it has begun, the cost comes back"
        named = await lifts.call("demand", "--robot", "lift 1", "--cost", "1wn", "--max-cost", "20wn", "--json")
        facts = {one.get("kind", "end"): one for one in map(json.loads, named.stdout.splitlines())}
        assert facts["posted"] == {
            "kind": "posted",
            "order": facts["posted"]["order"],
            "cost": "9",
            "robot": lifts.address("Lift 1"),
            "name": "Lift 1",
            "deadline": facts["posted"]["deadline"],
        }
        assert facts["contract"]["agent"] == lifts.address("Lift 1")
        assert facts["end"]["success"]
        raised = await lifts.call("demand", "--cost", "1wn", "--max-cost", "20wn")
        assert ", 0.000000004 XRT for any robot, valid until" in raised.stdout


async def test_an_order_for_a_robot_that_was_chosen_is_not_posted_twice(lifts: Lifts) -> None:
    """There is no provider, so the first one stays open."""
    options = ("--robot", "cheapest", "--max-cost", "20wn")
    async with lifts.at_work("9wn", "4wn"):
        first = lifts.demand(*options, says="posted ")
        await asyncio.to_thread(first.start)
        await asyncio.to_thread(first.kill)
        identity = first.log().split("posted ")[1].split(",")[0]
        for again in (options, ("--max-cost", "4wn"), ("--robot", "Lift 2", "--cost", "4wn")):
            done = await lifts.call("demand", *again)
            assert (done.returncode, "[demand-exists]" in done.stderr) == (2, True)
            named = {lifts.short("Lift 2"), lifts.address("Lift 2")}  # on a busy machine its name is not known in time
            (who,) = re.findall(rf"the equal demand {identity}, 0.000000004 XRT for (.+), is open until", done.stderr)
            assert who in named
        for other in (("--max-cost", "3wn"), ("--cost", "5wn"), ("--robot", "Lift 1", "--cost", "4wn")):
            posted = lifts.demand(*other, says="posted ")
            await asyncio.to_thread(posted.start)
            await asyncio.to_thread(posted.kill)
            assert "1 other open order" in posted.log()
            withdrawn = posted.log().split("posted ")[1].split(",")[0]
            await asyncio.to_thread(
                aira, "order", "withdraw", withdrawn, "--on-chain", **lifts.site.variables("person")
            )


async def test_the_balance_covers_the_most_that_may_be_paid(lifts: Lifts) -> None:
    async with lifts.at_work("9wn", "4wn"):
        poor = await lifts.call("demand", "--robot", "cheapest", "--max-cost", "2000000")
    assert poor.returncode == 1
    assert "needs 2,000,000 XRT [balance-too-low]" in poor.stderr
    less = await lifts.call("demand", "--cost", "3wn", "--max-cost", "2wn")
    assert (less.returncode, "[invalid-options]" in less.stderr) == (2, True)


class Typed:
    """`aira` with these words in a terminal of its own: what it shows, and Ctrl-C."""

    def __init__(self, *words: str, variables: dict[str, str]) -> None:
        self.shown = ""
        self._words = words
        self._variables = environment(variables | {"TERM": "xterm", "COLUMNS": "200"})

    async def start(self) -> None:
        self._terminal, inside = os.openpty()
        command = ("setsid", "--ctty", "--wait", *AIRA, *self._words)
        self._process = await asyncio.create_subprocess_exec(
            *command, stdin=inside, stdout=inside, stderr=inside, env=self._variables
        )
        os.close(inside)
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        while True:
            try:
                read = await asyncio.to_thread(os.read, self._terminal, 1 << 16)
            except OSError:  # Linux: the other side is closed
                return
            self.shown += read.decode(errors="replace")

    async def until(self, words: str) -> None:
        """Wait until it shows that."""
        await until(lambda: words in self.shown or self._reading.done(), what=repr(words), seconds=SECONDS)
        assert words in self.shown, self.shown

    def press_ctrl_c(self) -> None:
        os.write(self._terminal, b"\x03")

    async def end(self) -> int:
        """Wait for its end; its exit code."""
        code = await asyncio.wait_for(self._process.wait(), SECONDS)
        await self._reading
        os.close(self._terminal)
        return code


async def test_ctrl_c_twice_in_a_terminal_stops_the_robot(lifts: Lifts) -> None:
    words = lifts.words("demand", "--cost", "4wn", "--robot", "Lift 2")
    async with lifts.site.provider(), lifts.at_work("9wn", "4wn"):
        person = Typed(*words, variables=lifts.site.variables("person"))
        await person.start()
        await asyncio.wait_for(lifts.began.wait(), SECONDS)
        await person.until("playing")
        person.press_ctrl_c()
        await person.until("press Ctrl-C again within 5 seconds to stop the robot (the cost comes back)")
        person.press_ctrl_c()
        assert await person.end() == 1
    assert "stopped by the customer: the customer pressed Ctrl-C (stopped); the cost was returned" in person.shown
    assert "the job is stopped" in person.shown


async def test_a_job_is_stopped_by_a_command_while_another_waits_for_its_end(lifts: Lifts) -> None:
    waiting = lifts.demand("--cost", "4wn", "--robot", "first", "--max-cost", "9wn", says="contract 0x")
    async with lifts.site.provider(), lifts.at_work("9wn", "4wn"):
        await asyncio.to_thread(waiting.start)
        await asyncio.wait_for(lifts.began.wait(), SECONDS)
        contract = re.findall(r"contract (0x\w{40}) with", waiting.log())[0]
        words = ("liability", "stop", contract, "the box fell")
        stopped = await asyncio.to_thread(aira, *words, **lifts.site.variables("person"))
        assert (stopped.returncode, stopped.stdout.splitlines()[0]) == (0, f"stopped {contract}"), stopped.stderr
        assert await asyncio.to_thread(waiting.wait) == 1
        assert "stopped by the customer: the box fell (stopped); the cost was returned" in waiting.log()
