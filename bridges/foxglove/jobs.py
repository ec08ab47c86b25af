"""A job in Foxglove: live until it has ended, then its recording."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from bridges.foxglove.player import RecordingPlayer
from bridges.foxglove.server import FoxgloveServer
from bridges.foxglove.sources import show_job
from mesh.background import Background
from mesh.cli.errors import NoRecording
from mesh.errors import AiraError
from mesh.log_context import log_event
from mesh.recording import GENEROUS, open_objective

if TYPE_CHECKING:
    from pathlib import Path

    from bridges.foxglove.front import FoxgloveFront
    from bridges.web.components import WebComponents
    from schemas import Liability
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)

POLL_INTERVAL: Final = 2.0
"""Seconds between two questions whether a job has ended."""
OBJECTIVE_TIMEOUT: Final = 4.0
"""Seconds without a block after which a running job is shown without the definitions in its objective."""


async def show_job_until_end(parts: WebComponents, front: FoxgloveFront, address: str) -> Liability:
    """Show a job that runs; returns it when the chain has ended it. Raises `NotALiability`, `ChainError`."""
    liability = await parts.chain.liabilities.get(address)
    if liability.is_finalized:
        return liability
    session, promisor = parts.network.session, liability.promisor
    known = await _types_in(parts, liability.objective)
    async with FoxgloveServer(front, f"job {address}", front.drops, known=known) as server, Background() as tasks:
        tasks.start(show_job(server, session, promisor, address, drops=front.drops), "foxglove: job")
        return await _ended(parts, address)


async def show_recording(parts: WebComponents, front: FoxgloveFront, liability: Liability) -> None:
    """Play the recording of a job as clients control it, until cancelled. Raises `NoRecording`, `ContentError`."""
    if not liability.result:
        raise NoRecording(f"the job {liability.address} has ended without a recording")
    recording = await asyncio.to_thread(open_objective, await _fetch(parts, liability.result), GENEROUS)
    if not recording.count:
        raise NoRecording(f"the job {liability.address} has ended without a recording")
    player = RecordingPlayer(recording)
    name = f"recording of {liability.address}"
    async with FoxgloveServer(front, name, front.drops, control=player.control) as server:
        facts = log_event("recording-shown", liability=liability.address, recording=liability.result)
        log.info("%s has ended; its recording can be played", liability.address, extra=facts)
        await player.run(server)


async def _ended(parts: WebComponents, address: str) -> Liability:
    """A job when the chain has ended it. Waits while the node does not answer."""
    while True:
        await asyncio.sleep(POLL_INTERVAL)
        liability = await parts.chain.retrying(partial(parts.chain.liabilities.get, address))
        if liability.is_finalized:
            return liability


async def _types_in(parts: WebComponents, cid: str) -> tuple[PayloadType, ...]:
    """The types that a job's objective describes; none if it can't be read soon."""
    with suppress(AiraError):
        path = await _fetch(parts, cid, timeout=OBJECTIVE_TIMEOUT)
        return tuple(topic.type for topic in (await asyncio.to_thread(open_objective, path, GENEROUS)).topics)
    return ()


async def _fetch(parts: WebComponents, cid: str, timeout: float | None = None) -> Path:
    settings = parts.settings
    most = settings.fetch_timeout if timeout is None else min(timeout, settings.fetch_timeout)
    return await parts.exchange.fetch(cid, size_limit=settings.objective_expanded_limit, timeout=most)
