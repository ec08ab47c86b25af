"""The services of an agent: its jobs, its account on the chain, and the messages that it signs and sends for others.

Whoever reaches the router can ask. Reading is open to all. What signs, spends or speaks in the agent's name
(`schemas.rpc.GUARDED`) answers only where the setting `open_services` says so. The services that drive jobs answer
where it says so, too, and where nobody else could drive them: an agent with handlers works by itself, one without waits
to be told what to do, as the legacy stack did on the ROS network of its own robot. A router with access control can
keep strangers away from either.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from mesh.agent.chain_services import ChainServices
from mesh.agent.errors import ServiceClosed
from mesh.agent.message_services import MessageServices
from mesh.work.lifecycle import WrongPhase
from schemas import parse_address
from schemas.rpc import GUARDED, Done, LiabilityRead, Nothing

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.agent.components import AgentComponents
    from mesh.work.executor import Executor
    from schemas import Record
    from schemas.rpc import FinishLiability, ReadLiability, RestartLiability, ResumeLiability, StartLiability

    Answer = Callable[[Any], Awaitable[Record]]


log = logging.getLogger(__name__)


class JobServices:
    """`start`, `finish`, `restart`, `resume`, `read`: what is asked of an executor."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    async def read(self, request: ReadLiability) -> LiabilityRead:
        """The record of a job, if it is one of this agent's."""
        try:
            return LiabilityRead(True, await self._executor.read(parse_address(request.address)))
        except WrongPhase:
            return LiabilityRead(False)

    async def start(self, request: StartLiability) -> Done:
        """Play the objective."""
        return await _done(self._executor.start(parse_address(request.address)))

    async def restart(self, request: RestartLiability) -> Done:
        """Play it again from its beginning."""
        return await _done(self._executor.restart(parse_address(request.address)))

    async def resume(self, request: ResumeLiability) -> Done:
        """Play it on."""
        return await _done(self._executor.resume(parse_address(request.address)))

    async def finish(self, request: FinishLiability) -> Nothing:
        """Close the recording, sign the Result and send it. Raises `WrongPhase`."""
        await self._executor.finish(parse_address(request.address), success=request.success)
        return Nothing()


def offer_services(parts: AgentComponents, executor: Executor, *, drives_itself: bool) -> None:
    """Offer all services of the agent that these parts make up; `drives_itself` where its own code does the jobs."""
    jobs, is_open = JobServices(executor), parts.settings.open_services
    answers: dict[str, Answer] = {
        "read": jobs.read,
        **ChainServices(parts).answers(),
        **MessageServices(parts).answers(),
    }
    refused = frozenset() if is_open else GUARDED
    if is_open:
        log.warning("open_services: whoever reaches the router may spend and sign with %s", parts.signer.address)
    if parts.settings.enable_executor:
        driving: dict[str, Answer] = {
            "start": jobs.start,
            "restart": jobs.restart,
            "resume": jobs.resume,
            "finish": jobs.finish,
        }
        answers |= driving
        refused |= driving.keys() if drives_itself and not is_open else frozenset()
    for service, answer in answers.items():
        parts.services.offer(service, _refusal(service) if service in refused else answer)


def _refusal(service: str) -> Answer:
    async def refuse(_request: Record) -> Record:
        raise ServiceClosed(service)

    return refuse


async def _done(work: Awaitable[object]) -> Done:
    """The answer of the services that say whether they could."""
    try:
        await work
    except WrongPhase as error:
        return Done(False, str(error))
    return Done(True)
