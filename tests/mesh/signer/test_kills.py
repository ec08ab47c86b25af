"""A signer that is killed at any step of an order: one contract, found again by the key of the order."""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest

from mesh.dev import JsonRpcServer
from mesh.signer.client import SignerClient
from mesh.signer.protocol import SignerUnavailable
from tests.mesh.signer.killed import STEPS
from tests.support.signer.signers import GOOD, ended

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.signer.signers import Driver, Person

    Killed: TypeAlias = asyncio.subprocess.Process

PROGRAM = Path(__file__).parent / "killed.py"


@asynccontextmanager
async def process(
    person: Person, node: str, step: str = ""
) -> AsyncIterator[tuple[SignerClient, asyncio.subprocess.Process]]:
    """A signer in a process of its own, which kills itself at a step, and a client of its door."""
    names = ("connect", "lighthouse_contract", "ens_contract", "poll_interval", "playback")
    settings = person.signer().settings
    facts = {
        "key": KEYS[person.account.address],
        "policy": str(person.policy),
        "node": node,
        "settings": {name: getattr(settings, name) for name in (*names, "data_dir")},
    }
    path = person.folder / "facts.json"
    path.write_text(json.dumps(facts))
    arguments = [sys.executable, str(PROGRAM), str(path), *([step] if step else [])]
    started = await asyncio.create_subprocess_exec(*arguments, cwd=Path(__file__).parents[3])
    door = person.signer().door
    try:
        async with asyncio.timeout(60), SignerClient(door) as client:
            while True:
                with suppress(SignerUnavailable):
                    await client.balance()
                    break
                assert started.returncode is None or step, "the signer did not start"
                if started.returncode is not None:
                    break
                await asyncio.sleep(0.1)
            yield client, started
    finally:
        if started.returncode is None:
            started.kill()
        await started.wait()


KEYS: dict[str, str] = {}


@pytest.fixture(autouse=True)
def known_keys(person: Person, monkeypatch: pytest.MonkeyPatch) -> None:
    """The keys of the accounts of tests, which are made of their numbers."""
    from mesh.chain import Account
    from schemas import keccak256

    for number in range(1, 200):
        key = keccak256(f"an account of tests, number {number}".encode())
        if Account(key).address == person.account.address:
            KEYS[person.account.address] = key.hex()
            return
    raise AssertionError("its key is not known")


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.sample("step")
async def test_an_order_of_a_killed_signer_is_one_contract(person: Person, driver: Driver, step: str) -> None:
    person.allow(driver.model)
    order: dict[str, Any] = {"model": driver.model, "messages": [GOOD], "cost": "1 XRT", "idempotency_key": "k"}
    async with JsonRpcServer(person.market.chain.line) as server:
        async with process(person, server.url, step) as (door, killed):
            with suppress(SignerUnavailable):
                await door.order(**order)
            async with asyncio.timeout(40):
                assert await killed.wait() == -9
        async with process(person, server.url) as (door, _):
            job = await ended(door, await door.order(**order))
            assert (job.state, len(await door.jobs())) == ("done", 1)
            assert (await door.balance()).hour_left.text == "19 XRT"
    assert len(driver.begun) == 1
    assert await person.spent() == 10**9
