"""Stopping jobs: for the local account, or as a wallet has signed it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import msgspec

from bridges.web._access import WebError
from mesh.agent.contracts import send_stop
from mesh.errors import ChainError
from schemas import InvalidMessage

if TYPE_CHECKING:
    from bridges.web._market import Market, SeenJob
    from bridges.web.components import WebComponents
    from schemas.rpc import Stopped
    from schemas.signing import StopRequest


class Stops:
    """Passes stops on to robots, and remembers who stopped a job and why."""

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._sending = asyncio.Semaphore(16)  # requests at a time: a robot that is silent takes ten seconds

    async def send(self, request: StopRequest) -> dict[str, Any]:
        """Pass a signed request on; returns what the robot's devices say.

        Raises `InvalidMessage` for one that is not signed by a party of the job, `NotALiability`, `ServiceFailed`.
        """
        job = await self._stoppable(request.liability)
        liability = job.liability
        if not request.is_signed or request.by not in (liability.promisee, liability.promisor):
            raise InvalidMessage("signature", "a stop is signed by the customer or the robot of the job")
        async with self._sending:
            stopped = await send_stop(self._parts.network.session, liability.promisor, request)
        return self._done(job, by=request.by, why=request.why, stopped=stopped)

    async def stop(self, address: str, why: str) -> dict[str, Any]:
        """The local account stops its job. Raises `WebError`, and as `Contract.stop`."""
        if (agent := self._parts.agent) is None:
            hint = "sign the stop with your wallet"
            raise WebError("this server has no account", hint=hint, code="no-local-account")
        job = await self._stoppable(address)
        contract = await agent.contract(address)
        async with self._sending:
            stopped = await contract.stop(why)
        return self._done(job, by=agent.address, why=why, stopped=stopped)

    async def _stoppable(self, address: str) -> SeenJob:
        job = await self._market.job(address)
        if job.liability.is_finalized:
            raise ChainError(f"{address} has ended", code="liability-ended")
        return job

    def _done(self, job: SeenJob, *, by: str, why: str, stopped: Stopped) -> dict[str, Any]:
        known = self._market.jobs.get(job.liability.address, job)
        known.stopped = known.stopped or {"by": by, "why": why}
        return {"devices": [msgspec.structs.asdict(device) for device in stopped.devices]}
