"""The commands that serve and `aira demand`, in this process: their output and the files they leave."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.agent import Agent
from mesh.cli import demand as commands
from mesh.cli.provider import serve as serve_provider
from mesh.cli.router import serve as serve_router
from mesh.cli.up import serve_market as serve_up
from mesh.errors import AiraError, ConfigurationError, NetworkUnavailable
from mesh.role.composition import load_account
from mesh.settings import Settings
from schemas import EventKey, cid_of_bytes, cid_of_file
from tests.support.commands import coroutine
from tests.support.development import settings_of
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.ports import free_endpoint
from tests.support.raising import raises_with
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from mesh.agent.handlers import Job

demand = coroutine(commands.demand)
MODEL = cid_of_bytes(b"what is asked for on the command line")
ORDER = {"model": MODEL, "cost": "0", "validator": "", "validator_fee": "0", "lifetime": 1000}


class Printed:
    """The output so far."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.text = ""

    def __contains__(self, words: str) -> bool:
        self.text += self._capsys.readouterr().out
        return words in self.text

    def value(self, name: str) -> str:
        """The word after `name` at the beginning of a line."""
        return next(line.split()[1] for line in self.text.splitlines() if line.startswith(name))


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    return Printed(capsys)


async def stopped(serving: asyncio.Task[None]) -> None:
    """End a server as a signal does."""
    serving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await serving


async def said(serving: asyncio.Task[None], words: str, printed: Printed) -> None:
    await until(lambda: serving.done() or words in printed, what=words)
    if serving.done():
        await serving


def start(server: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    return asyncio.create_task(server)


async def test_a_job_from_up_to_the_recording(tmp_path: Path, printed: Printed) -> None:
    endpoint = free_endpoint()
    up = start(serve_up(Settings(listen=(endpoint,), data_dir=str(tmp_path)), port=0, block_time=0.1))
    await said(up, "provider    0x", printed)
    assert printed.value("router") == endpoint
    person = settings_of("person", tmp_path, url=printed.value("chain"), endpoint=endpoint)
    robot = settings_of("robot", tmp_path, url=printed.value("chain"), endpoint=endpoint)
    path, out = tmp_path / "job.mcap", tmp_path / "new" / "result.mcap"
    path.write_bytes(objective(("/go", "there")))
    order: dict[str, Any] = ORDER | {"cost": "7wn"}
    async with offering(moving(Agent(MODEL, settings=robot, account=load_account(robot)))), asyncio.timeout(60):
        await demand(person, objective=str(path), out=out, as_json=False, **order)
        assert f"paid, result {cid_of_file(out)}\nrecording {out}\n" in printed
        assert f"demand by {load_account(person).address} for {MODEL}\nobjective " in printed
        assert f"objective {cid_of_file(path)}: 1 message, 0 s\nposted " in printed
        assert "\ncontract 0x" in printed
        printed.text = ""
        await demand(person, objective=cid_of_file(path), out=None, as_json=True, **order)
        assert '"liability"' in printed
        kinds, end = progress_and_end(printed.text)
        assert [kind for kind in kinds if kind not in ("offer", "gone", "back")] == [
            "objective", "posted", "contract", "ready", "playing", "result", "paid",
        ]  # fmt: skip
        assert set(end) == {"liability", "robot", "success", "result", "recording"}
        assert cid_of_file(Path(end["recording"])) == end["result"]
        assert str(tmp_path) in end["recording"]
        printed.text = ""
        full = Path("/dev/full")
        with raises_with(AiraError, code="output-failed", match="/dev/full") as caught:
            await demand(person, objective=cid_of_file(path), out=full, as_json=True, **order)
        assert '"liability"' in printed
        _, summary = progress_and_end(printed.text)
        assert (summary["success"], summary["recording"], summary["error"]) == (True, None, str(caught.value))
        assert cid_of_file(Path(caught.value.hint.split()[-1])) == summary["result"]
    await stopped(up)


def progress_and_end(text: str) -> tuple[list[str], dict[str, Any]]:
    """The kinds of what happened, without repetitions, and the object that is printed at the end."""
    *progress, end = map(json.loads, text.splitlines())
    return list(dict.fromkeys(one["kind"] for one in progress)), end


def moving(robot: Agent) -> Agent:
    @robot.on("/go")
    async def go(job: Job, message: object) -> None:
        # What a robot says of its job is lost before somebody listens, and the person may see the contract later.
        key = EventKey(robot.address.lower(), job.liability.address.lower(), "complete")
        await until_heard(robot.parts.network.session, str(key))
        job.publish("/gone", message)

    return robot


async def test_a_router_and_a_provider_run_separately(tmp_path: Path, printed: Printed) -> None:
    endpoint = free_endpoint()
    router = start(serve_router(Settings(listen=(endpoint,))))
    await said(router, f"listens at {endpoint}\n", printed)
    up = start(serve_up(Settings(listen=(free_endpoint(),), data_dir=str(tmp_path)), port=0, block_time=60))
    await said(up, "provider    0x", printed)
    url = printed.value("chain")
    provider = start(serve_provider(settings_of("provider", tmp_path, url=url, endpoint=endpoint)))
    await said(provider, "serves airalab.lighthouse.3.robonomics.eth, Zenoh id ", printed)
    for server in (provider, up, router):
        await stopped(server)


async def test_a_failed_demand_leaves_no_recording(tmp_path: Path, printed: Printed) -> None:
    up = start(serve_up(Settings(listen=(free_endpoint(),), data_dir=str(tmp_path)), port=0, block_time=60))
    await said(up, "provider    0x", printed)
    nowhere = settings_of("person", tmp_path, url=printed.value("chain"), endpoint=free_endpoint(), connect_timeout=1.0)
    out, kept = tmp_path / "new.mcap", tmp_path / "old.mcap"
    kept.write_bytes(b"an earlier one")
    order: dict[str, Any] = ORDER | {"objective": MODEL, "as_json": True}
    for path in (out, kept):
        with pytest.raises(NetworkUnavailable):
            await demand(nowhere, out=path, **order)
    assert (out.exists(), kept.read_bytes()) == (False, b"an earlier one")
    await stopped(up)


async def test_a_role_that_can_not_listen_is_an_error_and_leaves_nothing_open(tmp_path: Path, printed: Printed) -> None:
    endpoint = free_endpoint()
    router = start(serve_router(Settings(listen=(endpoint,))))
    await said(router, "listens at", printed)
    for server in (
        serve_router(Settings(listen=(endpoint,))),
        serve_up(Settings(listen=(endpoint,), data_dir=str(tmp_path)), port=0, block_time=1.0),
    ):
        with pytest.raises(ConfigurationError, match=endpoint):
            await server
    assert not (tmp_path / "development").exists()
    await stopped(router)
