"""`aira demand --validator`: what it means is said before anything is signed, and the verdict with its reasons."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest

from mesh.cli import demand as commands
from mesh.errors import AiraError
from schemas import Demand, Result, Verified
from tests.support.cli.site import GENERATION_5, MODEL, Site, settings_of
from tests.support.commands import AIRA, Serving, aira, coroutine
from tests.support.jurors import COMPLETE, MISSING, Juror
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh import Agent
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

demand = coroutine(commands.demand)
TERMS: dict[str, Any] = {"model": MODEL, "cost": "7wn", "lifetime": 500, "out": None}


@pytest.fixture
async def site(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Site:
    return await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)


@pytest.fixture
async def juror(site: Site) -> AsyncIterator[Juror]:
    """A validator of generation 3, an account with ether that has sent a transaction, as `aira validator` does."""
    async with site.chain("rival") as chain:
        await chain.validators.introduce()
    signer = site.accounts["rival"].signer
    async with Juror(endpoint=site.endpoint, lighthouse=site.lighthouse, signer=signer) as juror:
        yield juror


async def judge(site: Site, juror: Juror, *, success: bool) -> None:
    """Judge the first result on the market, report it to both parties, and end its contract."""
    async with site.agent("rival") as reader, reader.channel.subscribe(Result) as results:
        result = (await anext(aiter(results))).message
        contract = await reader.contract(result.liability)
        juror.judge(contract, result.result, success=success)
        await reader.parts.chain.liabilities.validate(result, agree=success)


async def ordered(site: Site, robot: Agent, juror: Juror, *, success: bool, as_json: bool) -> None:
    """Order a job under the juror's judgement, until it ends."""
    async with site.provider(), robot, asyncio.TaskGroup() as tasks:
        tasks.create_task(judge(site, juror, success=success))
        objective, validator = str(site.job("word")), juror.signer.address
        await demand(
            settings_of(site, "person"),
            objective=objective,
            validator=validator,
            validator_fee=None,
            as_json=as_json,
            **TERMS,
        )


async def test_a_person_reads_what_the_validator_means_and_how_it_judged(
    site: Site, juror: Juror, capsys: pytest.CaptureFixture[str]
) -> None:
    await ordered(site, site.robot([]), juror, success=True, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    said = lines.index(f"validator {juror.title}, {juror.signer.address}")
    assert said < next(number for number, line in enumerate(lines) if line.startswith("posted "))
    assert lines[said + 1].startswith("  it is on the mesh; nobody is paid ")
    assert lines[said + 2] == f"  judges by complete: {COMPLETE.description}"
    assert lines[said + 3].startswith("  fee 0.0000001 XRT, ")
    assert lines[said + 4].startswith("  if it is silent: cost and fee can be refunded 50,400 blocks")
    assert f"juror {juror.signer.address} judged: the work counts" in lines
    assert any(line.startswith("paid, result") for line in lines)


async def test_a_refusal_is_told_with_its_reason_also_later(
    site: Site, juror: Juror, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ExceptionGroup) as caught:
        await ordered(site, site.robot([]), juror, success=False, as_json=True)
    assert [getattr(error, "code", "") for error in caught.value.exceptions] == ["job-not-done"]
    *progress, end = map(json.loads, capsys.readouterr().out.splitlines())
    meant = next(one for one in progress if one["kind"] == "validator")
    assert (meant["fee"], meant["announcedFee"], meant["online"]) == ("100", "100", [juror.signer.address])
    assert meant["policies"] == [{"name": COMPLETE.name, "description": COMPLETE.description}]
    judged = next(one for one in progress if one["kind"] == "judged")
    assert (judged["agent"], judged["code"], judged["votes"]) == (juror.signer.address, MISSING.code, 1)
    assert (end["code"], len(end["reports"])) == (MISSING.code, 1)
    assert MISSING.detail in end["reason"]
    variables = site.variables("person")
    shown = await asyncio.to_thread(aira, "liability", "show", end["liability"], "--json", **variables)
    assert json.loads(shown.stdout)["reports"] == end["reports"]
    shown = await asyncio.to_thread(aira, "liability", "show", end["liability"], **variables)
    assert f"the work does not count: {MISSING.detail} ({MISSING.code})" in shown.stdout


@pytest.mark.parametrize("who", ["silent", "cheap", "lighthouse"])
async def test_a_doubtful_validator_is_named_before_anything_is_signed(
    site: Site, juror: Juror, who: str, capsys: pytest.CaptureFixture[str]
) -> None:
    async with site.chain("person") as chain:
        lighthouse = await chain.names.address(site.lighthouse)
    validator = {"silent": site.address("provider"), "cheap": juror.signer.address, "lighthouse": lighthouse}[who]
    fee = "99wn" if who == "cheap" else None
    options: dict[str, Any] = {"objective": str(site.job("word")), "validator": validator, "validator_fee": fee}
    settings = settings_of(site, "person")
    expected = "validator-unsafe" if who == "lighthouse" else "validator-doubtful"
    with raises_with(AiraError, code=expected):
        async with asyncio.timeout(60):
            await demand(settings, as_json=True, **options, **TERMS)
    async with site.agent("person") as person:
        assert person.orders() == []
    if who == "lighthouse":
        return
    (said,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert list(said["doubts"]) == ["low-fee" if who == "cheap" else "silent"]
    waiting = asyncio.create_task(demand(settings, as_json=False, confirmed=True, **options, **TERMS))
    async with site.agent("poor") as watcher, watcher.channel.subscribe(Demand) as demands:
        async with asyncio.timeout(60):
            posted = (await anext(aiter(demands))).message
    waiting.cancel()
    await asyncio.wait([waiting])
    assert (posted.validator, posted.validator_fee) == (validator, 99 if who == "cheap" else 0)


@pytest.mark.sample("lies")
@pytest.mark.parametrize("lies", [False, True])
async def test_a_whole_job_by_commands_under_a_real_validator(site: Site, lies: bool) -> None:
    """`aira provider`, `aira validator` and `aira demand` are processes."""
    variables = site.variables("rival", log_format="json", validator_title="Word inspectors", validator_fee="100wn")
    serving = Serving(*AIRA, "validator", says='"validator-started"', variables=variables)
    robot = lying(site) if lies else site.robot([])
    options = ("--model", MODEL, "--objective", site.job("word"), "--cost", "7wn", "--validator", site.address("rival"))
    with serving:
        async with site.provider(), robot:
            done = await asyncio.to_thread(aira, "demand", *options, **site.variables("person"))
            lines = done.stdout.splitlines()
            address = next(line for line in lines if line.startswith("contract ")).split()[1]
            shown = await asyncio.to_thread(aira, "liability", "show", address, **site.variables("person"))
    assert f"validator Word inspectors, {site.address('rival')}" in lines
    assert any(line.startswith("  judges by complete: ") for line in lines)
    judged = next(line for line in lines if line.startswith(f"juror {site.address('rival')} judged: the work "))
    verdict = judged.split(" judged: ")[1]
    assert verdict in shown.stdout
    if lies:
        assert (done.returncode, verdict.startswith("the work does not count: ")) == (1, True)
        assert "the validator judged that the work does not count: " in done.stderr
        assert "the validator judged that the work does not count: " in shown.stdout
    else:
        assert (done.returncode, verdict) == (0, "the work counts"), done.stderr


async def test_a_whole_job_by_commands_under_a_jury_of_generation_5(site: Site) -> None:
    """`aira validator deploy`, two jurors that must judge alike, and a demand that names their contract."""
    common = GENERATION_5 | {"log_format": "json"}
    jurors = [site.address(role) for role in ("rival", "poor")]
    named = [word for juror in jurors for word in ("--juror", juror)]
    person = site.variables("person", **common)
    deployed = await asyncio.to_thread(aira, "validator", "deploy", *named, "--quorum", "2", "--json", **person)
    jury = json.loads(deployed.stdout)["validator"]
    options = ("--model", MODEL, "--objective", site.job("word"), "--cost", "7wn", "--validator", jury, "--json")
    async with AsyncExitStack() as stack:
        for role, fee in (("rival", "100wn"), ("poor", "50wn")):
            variables = site.variables(role, validator_contract=jury, validator_fee=fee, **common)
            serving = Serving(*AIRA, "validator", says='"validator-started"', variables=variables)
            await stack.enter_async_context(serving)
        for member in (site.provider(), site.robot([], **{**common, "generation": 5})):
            await stack.enter_async_context(member)
        done = await asyncio.to_thread(aira, "demand", *options, **person)
    assert done.returncode == 0, done.stderr
    *progress, end = map(json.loads, done.stdout.splitlines())
    meant = next(one for one in progress if one["kind"] == "validator")
    assert (sorted(meant["online"]), meant["quorum"], meant["fee"]) == (sorted(jurors), 2, "100")
    judged = [one for one in progress if one["kind"] == "judged"]
    assert [(one["votes"], one["needed"], one["code"]) for one in judged] == [(1, 2, ""), (2, 2, "")]
    assert (end["success"], sorted(one["juror"] for one in end["reports"])) == (True, sorted(jurors))


def lying(site: Site) -> Agent:
    """A robot that claims success at once, with the objective as its recording."""
    robot = site.agent("robot", enable_executor=False)

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    @robot.every(0.5)
    async def claim() -> None:
        for _, address in await robot.parts.ledger.contracts("offer"):
            liability = await robot.parts.chain.liabilities.get(address)
            robot.send(Result(liability=address, result=liability.objective, success=True))

    return robot


async def test_who_watches_a_liability_sees_the_verdict_when_it_is_there(site: Site, juror: Juror) -> None:
    async with site.provider(), site.robot([]) as robot, site.agent("person") as person:
        contract = await person.demand(site.job("word"), cost=7, validator=juror.signer.address)
        command, variables = (*AIRA, "liability", "watch", contract.address), site.variables("person")
        async with Serving(*command, says="must judge the result: 1 juror alike", variables=variables) as watching:
            juror.judge(contract, contract.liability.objective, success=False)
            line = f"juror {juror.signer.address} judged: the work does not count: {MISSING.detail}"
            await asyncio.to_thread(watching.wait_until_said, line)
        assert robot.address == contract.liability.promisor
