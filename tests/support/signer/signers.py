"""Signers for tests: real ones, behind their sockets, in a market with a robot that drives."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta

from mesh import Agent, Empty, JobFailed
from mesh.signer.client import SignerClient
from mesh.signer.service import Signer
from mesh.testing._market import ALLOWANCE, RESEND

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mesh.agent.handlers import Job
    from mesh.chain import Account
    from mesh.signer.protocol import Job as SignerJob
    from mesh.testing import Market
    from schemas import Demand, Verified

LIMITS = """
[budget]
per_job = "5 XRT"
per_hour = "20 XRT"
per_day = "50 XRT"
jobs_at_a_time = 8

[consent]
above = "3 XRT"
valid = "10 min"
"""
RULE = """
[[allow]]
models = ["{model}"]
robots = {robots}
[allow.topics."/drive"]
radius = {{ min = 0.2, max = 2.0 }}
direction = {{ one_of = ["left", "right"] }}
label = {{ any = true, optional = true }}
"points[].x" = {{ min = 0, max = 5, optional = true }}
[allow.topics."/speed"]
max = 2
min = 0
[allow.topics."/stop"]
"""


class Drive(msgspec.Struct):
    """What the robot of these tests is ordered to do."""

    radius: float
    direction: str
    label: str = ""
    points: list[dict[str, float]] = []


GOOD = ("/drive", {"radius": 1.0, "direction": "left"})


class Driver:
    """A robot that offers for all demands, and works until `released` is set; `begun` are the jobs that it began."""

    def __init__(self, folder: Path, *, price: str = "1 XRT", **settings: Any) -> None:
        from mesh.settings import Settings

        self.begun: list[str] = []
        self.played: list[Any] = []
        self.released = asyncio.Event()
        self.released.set()
        described = self._made("", Settings(**settings))
        description = described.model_description("a driver", price=price, description="It drives in circles.")
        path = folder / f"driver-{len(list(folder.iterdir()))}.json"
        path.write_bytes(description.encode())
        self.model = description.cid
        self.agent = self._made(path, Settings(name="Rover", about="It drives.", **settings))

    def _made(self, model: Any, settings: Any) -> Agent:
        agent = Agent(model, settings=settings)

        @agent.on("/drive")
        async def drive(job: Job, message: Drive) -> None:
            self.begun.append(job.liability.address)
            self.played.append(message)
            job.publish("/odometry", {"radius": message.radius})
            while not self.released.is_set():  # again: who reads of the contract late has missed the first ones
                job.publish("/odometry", {"radius": message.radius})
                await asyncio.sleep(0.05)
            if message.label == "fail":
                raise JobFailed("the wheel is \u202eloose", code="wheel-loose")

        @agent.on("/speed")
        async def speed(job: Job, message: Annotated[float, Meta(ge=0)]) -> None:
            self.played.append(message)

        @agent.on("/stop")
        async def stop(job: Job, message: Empty) -> None:
            self.played.append(message)

        @agent.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            await agent.offer(demand)

        return agent


class Person:
    """An account with money, its policy's file, and the folder of its signer."""

    def __init__(self, market: Market, folder: Path, account: Account) -> None:
        self.market = market
        self.folder = folder
        self.account = account
        self.policy = folder / "policy.toml"

    def allow(self, model: str, *, robots: str = '["*"]', limits: str = LIMITS, rule: str = RULE) -> None:
        self.policy.write_text(limits + rule.format(model=model, robots=robots))
        self.policy.chmod(0o600)

    def signer(self, **options: Any) -> Signer:
        """A signer, not yet open."""
        import dataclasses

        settings = dataclasses.replace(self.market.settings("unused"), data_dir=str(self.folder / "state"))
        chain = options.pop("chain", None) or self.chain
        return Signer(settings, self.policy, account=self.account, chain=chain, resend=RESEND, **options)

    @asynccontextmanager
    async def at_work(self, **options: Any) -> AsyncIterator[tuple[SignerClient, SignerClient, Signer]]:
        """A door's client, the owner's client, and the signer."""
        async with (
            self.signer(**options) as signer,
            SignerClient(signer.door) as door,
            SignerClient(signer.owner) as owner,
        ):
            yield door, owner, signer

    async def __aenter__(self) -> Person:
        self._bank = self.market.chain.bank()
        async with self._bank as bank:
            await self.market.chain.fund(bank, self.account.address)
        self.chain = self.market.chain.chain(self.account)
        await self.chain.__aenter__()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self.chain.__aexit__(*exc_info)

    async def spent(self) -> int:
        """What the account has paid so far, in wn."""
        return ALLOWANCE - await self.chain.tokens.balance(self.account.address)


def short_folder() -> Iterator[Path]:
    """A folder whose path is short enough for a socket."""
    folder = Path(tempfile.mkdtemp(prefix="aira-s-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


async def ended(door: SignerClient, job: SignerJob, *, seconds: float = 40.0) -> SignerJob:
    """The job once it is over."""
    return await reached(door, job, lambda one: one.is_over, seconds=seconds)


async def reached(door: SignerClient, job: SignerJob, condition: Any, *, seconds: float = 40.0) -> SignerJob:
    """The job once a condition holds."""
    async with asyncio.timeout(seconds):
        while not condition(job):
            job = await door.job(job.job_id, revision=job.revision, wait_seconds=5.0)
    return job
