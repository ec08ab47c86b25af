"""`aira demand`: what a person sees of the objective, of robots that decline, of failures, and of an interruption."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Declined, JobFailed, Progress
from mesh.agent.objectives import ObjectiveUnfit
from mesh.agent.orders import OrderExpired
from mesh.amounts import XRT
from mesh.chain import Chain, Node
from mesh.cli import demand as commands
from mesh.cli.demand import DEMAND_PACE, JobPrinter, _who_is_here
from mesh.errors import RemoteError
from mesh.watching import present
from schemas import cid_of_bytes, cid_of_file
from tests.support.cli.site import MODEL, Site, settings_of
from tests.support.commands import aira, coroutine
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.ports import free_endpoint
from tests.support.raising import raises_with
from tests.support.tokens import block, deploy_blocking_token
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh import Agent
    from schemas import Demand, Verified
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

demand = coroutine(commands.demand)
AGENT = "0x70997970C51812dc3A010C7d01b50e0d17dc79C8"
TERMS: dict[str, Any] = {"model": MODEL, "cost": "7wn", "validator": "", "validator_fee": "0", "lifetime": 500}


@pytest.fixture
async def site(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Site:
    return await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)


class Output:
    """What a command has printed so far."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self._out = self._err = ""

    @property
    def out(self) -> str:
        captured = self._capsys.readouterr()
        self._out, self._err = self._out + captured.out, self._err + captured.err
        return self._out

    @property
    def err(self) -> str:
        self.out  # reads both  # noqa: B018
        return self._err


@pytest.fixture
def output(capsys: pytest.CaptureFixture[str]) -> Output:
    return Output(capsys)


@pytest.mark.parametrize(("content", "reason"), [(b"no recording", "not-a-recording"), (objective(), "no-messages")])
async def test_an_objective_that_no_robot_takes_is_an_error_before_anything_is_sent(
    tmp_path: Path, site: Site, content: bytes, reason: str
) -> None:
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    with pytest.raises(ObjectiveUnfit) as caught:
        await demand(settings_of(site, "person"), objective=str(path), out=None, as_json=False, **TERMS)
    assert (caught.value.reason, caught.value.cid) == (reason, str(path))
    async with site.agent("person") as person:
        assert person.orders() == []


async def test_an_interrupted_demand_does_not_wait_for_a_node_that_is_silent(
    site: Site, output: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before that, it says how far its agent has read the chain, as long as that is behind."""
    monkeypatch.setattr("mesh.cli.demand.DEMAND_PACE", DEMAND_PACE._replace(silence=0.05))
    monkeypatch.setattr("mesh.cli.demand.BEHIND", -1)
    waiting = asyncio.create_task(
        demand(settings_of(site, "person"), objective=str(site.job("word")), out=None, as_json=False, **TERMS)
    )
    said = ("reading the chain: block", "no robot has offered or declined yet")  # the second once it has ordered
    await until(lambda: all(text in output.err for text in said), seconds=60)
    monkeypatch.setattr(Node, "block_number", lambda _: asyncio.Event().wait())
    waiting.cancel()
    async with asyncio.timeout(20):
        await asyncio.wait([waiting])
    assert "the demand stays valid until block" in output.err


async def test_a_model_may_be_given_as_a_file_which_robots_can_fetch_then(site: Site, tmp_path: Path) -> None:
    path = tmp_path / "model.md"
    path.write_bytes(b"what nobody here does")
    terms = TERMS | {"model": str(path)}
    async with site.provider(), site.agent("robot") as robot:
        waiting = asyncio.create_task(
            demand(settings_of(site, "person"), objective=str(site.job("word")), out=None, as_json=False, **terms)
        )
        await until_found(lambda: robot.parts.exchange.is_held(cid_of_file(path), timeout=1), what="the model's file")
        waiting.cancel()
        await asyncio.wait([waiting])


async def test_a_robot_that_declines_is_shown_with_its_reason(site: Site, output: Output) -> None:
    robot = site.agent("robot")

    @robot.on_demand
    async def weigh(demand: Verified[Demand]) -> None:
        raise Declined("too-cheap", "costs at least 5 XRT")

    async with site.provider(), robot:
        waiting = asyncio.create_task(
            demand(
                settings_of(site, "person"),
                objective=str(site.job("word")),
                out=None,
                as_json=False,
                wait=True,
                **TERMS,
            )
        )
        line = f"declined by {robot.address}: costs at least 5 XRT (too-cheap)\n"
        await until(lambda: line in output.out, seconds=60)
        waiting.cancel()
        await asyncio.wait([waiting])
    assert "the demand stays valid until block" in output.err


async def test_a_robot_with_a_name_is_shown_by_it_and_its_short_address(site: Site, output: Output) -> None:
    robot = site.agent("robot", name="Lift 1")

    @robot.on_demand
    async def weigh(demand: Verified[Demand]) -> None:
        raise Declined("too-cheap")

    async with site.provider(), robot:
        waiting = asyncio.create_task(
            demand(
                settings_of(site, "person"),
                objective=str(site.job("word")),
                out=None,
                as_json=False,
                wait=True,
                **TERMS,
            )
        )
        who = f"Lift 1 ({robot.address[:6]}…{robot.address[-4:]})"
        await until(lambda: f"declined by {who}: (too-cheap)\n" in output.out, seconds=60)
        waiting.cancel()
        await asyncio.wait([waiting])


def test_the_name_stands_beside_the_address_in_json(output: Output) -> None:
    printer = JobPrinter(XRT, as_json=True, name_of={AGENT: "Lift 1"}.__getitem__)
    printer(Progress(kind="offer", agent=AGENT))
    assert json.loads(output.out) == {"kind": "offer", "agent": AGENT, "name": "Lift 1", "code": "", "detail": ""}


async def _is_complete(robot: Agent) -> bool:
    return {"agent", "provider"} <= {peer.role for peer in await present(robot.channel)}


async def test_a_demand_that_no_robot_here_can_do_says_so(
    site: Site, output: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One agent is present, but of another model: at first, and when the demand has expired."""
    monkeypatch.setattr("mesh.cli.demand.DEMAND_PACE", DEMAND_PACE._replace(silence=0.1))
    other = cid_of_bytes(b"what nobody here demands")
    async with site.provider(), offering(site.agent("robot")) as robot, Chain(site.url) as chain:
        await until_found(lambda: _is_complete(robot), what="provider and robot")
        waiting = asyncio.create_task(
            demand(
                settings_of(site, "person"),
                objective=str(site.job("word")),
                out=None,
                as_json=False,
                **TERMS | {"model": other, "lifetime": 3},
            )
        )
        who = "no robot of this model is here: 1 other agent"
        await until(lambda: f"no robot has offered or declined yet; {who}" in output.err, seconds=60)
        await chain.node.request("anvil_mine", "0x4")
        with pytest.raises(OrderExpired):
            await waiting
        assert f"no robot offered or declined; {who}" in output.err
        assert robot.model == MODEL

        async def is_alone() -> bool:  # the person's token may still be there
            counted = await _who_is_here(robot)
            return counted.startswith("no robot of this model is here: 0 other agents, and 1 provider on")

        await until_found(is_alone)
        async with site.agent("person") as person:
            expected = "1 robot of this model and 1 provider are present on"

            async def is_counted() -> bool:
                return (await _who_is_here(person)).startswith(expected)

            await until_found(is_counted)
            assert person.model == robot.model
            no_robot = "no robot of this model is here: 1 other agent, and 1 provider on"
            assert (await _who_is_here(robot)).startswith(no_robot), "a person who orders is none"


async def test_a_failed_job_is_shown_with_its_reason_and_its_recording_is_kept(site: Site, output: Output) -> None:
    robot = site.agent("robot")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    @robot.on("/say")
    async def say(job: object, message: object) -> None:
        raise JobFailed("the lamp is broken")

    async with site.provider(), robot:
        with raises_with(RemoteError, code="job-not-done"):
            await demand(settings_of(site, "person"), objective=str(site.job("word")), out=None, as_json=True, **TERMS)
    checked, posted, *progress, end = map(json.loads, output.out.splitlines())
    assert (checked["kind"], checked["messages"]) == ("objective", 1)
    assert (posted["kind"], len(bytes.fromhex(posted["order"]))) == ("posted", 32)
    assert {
        "kind": "refunded",
        "agent": site.address("robot"),
        "code": "job-failed",
        "detail": "the lamp is broken",
    } in progress
    assert (end["reason"], end["code"]) == ("the lamp is broken", "job-failed")
    assert cid_of_file(Path(end["recording"])) == end["result"]
    # The robot and the router may be off: the recording is in the person's store.
    variables = site.variables("person", connect=free_endpoint())
    shown = await asyncio.to_thread(aira, "liability", "show", end["liability"], "--json", **variables)
    assert (json.loads(shown.stdout)["reason"], json.loads(shown.stdout)["code"]) == (end["reason"], end["code"])
    unknown = await asyncio.to_thread(
        aira,
        "liability",
        "show",
        end["liability"],
        "--json",
        **(variables | {"AIRA_DATA_DIR": str(site.folder / "no")}),
    )
    assert json.loads(unknown.stdout)["code"] == "recording-unavailable"


async def test_a_cost_that_the_token_refuses_to_return_is_owed(site: Site, output: Output) -> None:
    robot, person = site.agent("robot"), settings_of(site, "person")
    async with site.chain("person") as chain:
        token = await deploy_blocking_token(chain, 100)
        await block(chain, token, site.address("person"))
    robot.settings = replace(robot.settings, erc20_token=token)

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    @robot.on("/say")
    async def say(job: object, message: object) -> None:
        raise JobFailed("the lamp is broken")

    terms = TERMS | {"cost": "7units"}
    async with site.provider(), robot:
        with raises_with(
            RemoteError, code="job-not-done", match="the token refused to return the cost, `aira liability claim 0x"
        ):
            await demand(
                replace(person, erc20_token=token), objective=str(site.job("word")), out=None, as_json=True, **terms
            )
    assert json.loads(output.out.splitlines()[-1])["owed"] == "7"


async def test_an_interrupted_demand_is_withdrawn_if_asked_for(site: Site, output: Output) -> None:
    settings, options = settings_of(site, "person"), TERMS | {"withdraw_on_exit": True}
    async with site.provider():
        waiting = asyncio.create_task(
            demand(settings, objective=str(site.job("word")), out=None, as_json=False, **options)
        )
        await until(lambda: "posted " in output.out, seconds=60)
        identity = output.out.split("posted ")[1].split(",")[0]
        waiting.cancel()
        await asyncio.wait([waiting])
    assert f"demand {identity} is withdrawn" in output.err
    async with site.agent("person") as person:
        assert person.orders() == []


def test_progress_without_a_terminal_is_a_line_for_each_tenth(output: Output) -> None:
    printer = JobPrinter(XRT, as_json=False)
    for position in range(101):
        printer(Progress(kind="playing", agent=AGENT, position=position, total=100))
    lines = output.out.splitlines()
    assert len(lines) == 11
    assert lines[-1] == "playing: 100 %, 100 of 100 messages"


def test_what_strangers_write_does_not_control_the_terminal(output: Output) -> None:
    printer = JobPrinter(XRT, as_json=False)
    for kind in ("declined", "rejected"):
        printer(Progress(kind=kind, agent=AGENT, code="busy\x1b[2J", detail="\x1b[2Jlater"))
    assert "\x1b" not in output.out


def test_an_offer_for_another_cost_is_shown_with_its_unit(output: Output) -> None:
    printer = JobPrinter(XRT, as_json=False)
    printer(Progress(kind="offer", agent=AGENT, code="other-cost", detail="5000000000"))
    silent = [printer.is_silent]
    printer(Progress(kind="offer", agent=AGENT))
    assert [*silent, printer.is_silent] == [True, False]
    assert output.out == f"offer by {AGENT} for other terms: cost 5 XRT\noffer by {AGENT}\n"


def test_the_summary_counts_offers_and_declines() -> None:
    printer = JobPrinter(XRT, as_json=True)
    for agent, code in ((AGENT, "busy"), ("0x1", "too-cheap"), ("0x2", "too-cheap"), (AGENT, "too-cheap")):
        printer(Progress(kind="declined", agent=agent, code=code))
    assert printer.summary() == "0 robots offered, 3 robots declined (3 too-cheap)"
