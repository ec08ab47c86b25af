"""`aira verify`."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
import zenoh
from click.testing import CliRunner

from mesh.agent.agent import Agent
from mesh.agent.ledger import Phase
from mesh.chain.errors import NodeUnreachable
from mesh.cli import demand as commands
from mesh.cli import main, replay
from mesh.cli.up import serve_market as serve_up
from mesh.cli.validator import verify_job
from mesh.errors import AiraError, InvalidAddress
from mesh.role.composition import load_account
from mesh.settings import Settings
from schemas import cid_of_bytes
from tests.support.commands import aira, coroutine, refused
from tests.support.development import settings_of
from tests.support.listening import Listener
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.ports import free_endpoint
from tests.support.routers import client_config, wait_until_declared
from tests.support.validator.jobs import LIABILITY, OTHER, WORDS, make_job
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from click.testing import Result

    from mesh.agent.handlers import Job
    from tests.support.validator.jobs import SampleJob

demand = coroutine(commands.demand)
MODEL = cid_of_bytes(b"what is verified")


@pytest.fixture
def job(tmp_path: Path) -> SampleJob:
    return make_job(tmp_path)


def verified(job: SampleJob, *more: str | Path) -> Result:
    words = ["verify", "--objective", job.objective, "--result", job.result, "--data-dir", job.result.parent / "data"]
    return CliRunner().invoke(main, [str(word) for word in [*words, *more]])


def test_two_files_are_verified_without_chain_and_network(job: SampleJob) -> None:
    done = verified(job)
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert any(line.startswith("holds") and "played" in line and "all 6 messages" in line for line in lines)
    assert any(line.startswith("open") and "signature" in line for line in lines)
    assert lines[-1] == "0 of 17 checks failed, 7 stayed open"


def test_a_failed_check_is_named_and_the_exit_code_is_1(job: SampleJob) -> None:
    job.forge(lambda messages, metadata: messages[:4])
    done = verified(job)
    assert done.exit_code == 1
    assert "FAILS  closed" in done.stdout
    assert "closed it with 11 messages, and it has 4" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("2 of 17 checks failed")


def test_unplayed_messages_fail_without_chain_and_network(tmp_path: Path) -> None:
    done = verified(make_job(tmp_path, played=WORDS[:2]))
    assert done.exit_code == 1
    assert "FAILS  played" in done.stdout


def test_an_address_is_compared_with_the_one_in_the_recording(job: SampleJob) -> None:
    assert verified(job, LIABILITY, "--offline").exit_code == 0
    done = verified(job, OTHER, "--offline")
    assert done.exit_code == 1
    assert f"names the liability '{LIABILITY}'" in done.stdout


def test_with_the_message_the_signature_is_verified(job: SampleJob, tmp_path: Path) -> None:
    message = tmp_path / "result.json"
    message.write_bytes(job.message())
    done = verified(job, "--message", message, "--json")
    assert done.exit_code == 0
    said = json.loads(done.stdout)
    assert said["holds"] is True
    found = {finding["name"]: finding["holds"] for finding in said["findings"]}
    assert found["signature"] is True
    assert found["finalized"] is None


def test_control_characters_of_untrusted_text_are_not_printed(job: SampleJob) -> None:
    def evil(messages: list[Any], metadata: dict[str, dict[str, str]]) -> list[Any]:
        metadata["aira"]["liability"] = "\x1b[2J" + LIABILITY
        return messages

    job.forge(evil)
    done = verified(job, LIABILITY, "--offline")
    assert done.exit_code == 1
    assert "\x1b" not in done.stdout


@pytest.mark.parametrize(
    ("words", "error", "value"),
    [
        (["verify"], "invalid-options", "files"),
        (["verify", LIABILITY, "--offline"], "invalid-options", "files"),
        (["verify", "--objective", "nowhere", "--result", "nowhere"], "file-unreadable", "nowhere"),
        (["verify", "--objective", ".", "--result", "."], "file-unreadable", "."),
        (["verify", "0x12", "--offline", "--objective", "a", "--result", "b"], InvalidAddress, "0x12"),
        (["verify", LIABILITY, "--web3-http-provider", "http://127.0.0.1:9"], NodeUnreachable, "http://127.0.0.1:9"),
    ],
)
def test_unreadable_input_is_one_clear_line_and_exit_code_2(
    tmp_path: Path, words: list[str], error: type[AiraError], value: str
) -> None:
    done = CliRunner().invoke(main, [*words, "--data-dir", str(tmp_path)])
    refused(done, error, value, exit_code=2)


def test_a_result_that_is_no_recording_fails(job: SampleJob) -> None:
    job.result.write_bytes(b"no recording")
    done = verified(job)
    assert done.exit_code == 1
    assert "it is neither an MCAP file" in done.stdout


def test_it_runs_as_a_separate_process(job: SampleJob) -> None:
    done = aira("verify", "--objective", job.objective, "--result", job.result, AIRA_DATA_DIR=str(job.result.parent))
    assert (done.returncode, done.stderr) == (0, "")


@asynccontextmanager
async def served_market(folder: Path, capsys: pytest.CaptureFixture[str]) -> AsyncIterator[tuple[str, str]]:
    """`aira up` in this process: the router's endpoint and the chain's URL."""
    endpoint, printed = free_endpoint(), ""
    up = asyncio.create_task(serve_up(Settings(listen=(endpoint,), data_dir=str(folder)), port=0, block_time=0.1))

    def served() -> bool:
        nonlocal printed
        printed += capsys.readouterr().out
        return up.done() or "provider    0x" in printed

    await until(served, seconds=60)
    yield endpoint, next(line.split()[1] for line in printed.splitlines() if line.startswith("chain"))
    up.cancel()
    with pytest.raises(asyncio.CancelledError):
        await up


def moving(robot: Settings) -> Agent:
    """A robot that goes where a message says."""
    agent = offering(Agent(MODEL, settings=robot, account=load_account(robot)))

    @agent.on("/go")
    async def go(job: Job, message: object) -> None:
        job.publish("/gone", message)

    return agent


async def has_finalized(robot: Agent, liability: str) -> bool:
    """Whether a robot knows that its contract has ended, and has nothing to say of it any more."""
    job = await robot.parts.ledger.job(liability)
    return job is not None and job.phase is Phase.FINALIZED


async def test_a_job_of_the_market_is_verified_from_its_address_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, easier = tmp_path / "job.mcap", tmp_path / "easier.mcap"
    path.write_bytes(objective(("/go", "there"), ("/go", "back")))
    easier.write_bytes(objective(("/go", "there")))
    order: dict[str, Any] = {"model": MODEL, "cost": "7wn", "validator": "", "validator_fee": None, "lifetime": 1000}
    nothing: dict[str, Any] = {"result": None, "message": None, "offline": False}
    again: dict[str, Any] = {"topics": None, "role": None, "rate": 1.0, "at_once": False, "start": 0.0}
    async with asyncio.timeout(180), served_market(tmp_path, capsys) as (endpoint, url):
        robot, person = (
            settings_of(role, tmp_path, url=url, endpoint=endpoint, connect_timeout=30.0, fetch_timeout=5.0)
            for role in ("robot", "person")
        )
        folder = str(tmp_path / "arbiter")
        nobody = Settings(connect=(endpoint,), fetch_timeout=10.0, web3_http_provider=url, data_dir=folder)
        play_again = partial(coroutine(replay.command), nobody, as_json=False, **again)
        async with moving(robot) as worker:
            await demand(person, objective=str(path), out=None, as_json=True, **order)
            liability = json.loads(capsys.readouterr().out.splitlines()[-1])["liability"]
            await until_found(lambda: has_finalized(worker, liability), what="the robot's last word", seconds=60)
            assert await verify_job(nobody, liability=liability, objective=None, as_json=True, **nothing)
            said = json.loads(capsys.readouterr().out)
            assert [finding["holds"] for finding in said["findings"]] == [True] * 17
            with zenoh.open(client_config(endpoint)) as session:
                listener = Listener(session)
                await asyncio.to_thread(wait_until_declared, endpoint, "any/key")
                await play_again(source=liability, of_objective=False, to=None)
                robots = f"aira/agent/{load_account(robot).address.lower()}/liability/{liability.lower()}"
                keys = await asyncio.to_thread(listener.keys, 4)
                assert sorted(keys)[:4] == [f"{robots}/objective/go"] * 2 + [f"{robots}/topic/gone"] * 2
                await play_again(source=liability, of_objective=True, to="lab/stage")
                await until(lambda: [key for key in listener.keys(0) if key.startswith("lab/")] == ["lab/stage/go"] * 2)
            capsys.readouterr()
            assert not await verify_job(nobody, liability=liability, objective=easier, as_json=False, **nothing)
            assert "FAILS  objective-file" in capsys.readouterr().out
            with pytest.raises(AiraError):
                await verify_job(nobody, liability=OTHER, objective=None, as_json=False, **nothing)
