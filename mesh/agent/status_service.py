"""How an agent with an account is, for whoever asks: what the legacy stack's list of nodes showed, and its work."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import mesh
from mesh.network.metrics import link_state
from schemas.status import ALIVE, OFF, Status, StoreUse, Work

if TYPE_CHECKING:
    from mesh.agent.components import AgentComponents
    from mesh.work.executor import Executor
    from mesh.work.listener import Listener
    from schemas.rpc import Nothing


class StatusService:
    """`status`: how the agent that these parts make up is. It changes nothing, and asks neither chain nor network."""

    def __init__(self, parts: AgentComponents, executor: Executor, listener: Listener) -> None:
        self._parts = parts
        self._executor = executor
        self._listener = listener
        self._began = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """How it is now."""
        parts = self._parts
        return Status(
            role="agent",
            address=parts.signer.address,
            version=mesh.__version__,
            zenoh_id=parts.network.id,
            lighthouse=parts.channel.lighthouse,
            parts=self.parts(),
            head=parts.clock.head,
            chain_id=parts.chain.chain_id,
            xrt=parts.chain.xrt,
            uptime=round(time.monotonic() - self._began, 3),
            work=await self._work(),
        )

    def parts(self) -> dict[str, str]:
        """Of the four nodes of the legacy stack. The signer has its key in memory, or there is no agent."""
        if not self._parts.settings.enable_executor:
            executor = OFF
        else:
            executor = ALIVE if self._executor.is_running else "has not begun"
        return {
            "executor": executor,
            "channel": link_state(self._parts.network),
            "signer": ALIVE,
            "listener": "waits for the node" if self._listener.waits else ALIVE,
        }

    async def _work(self) -> Work:
        usage = await asyncio.to_thread(self._parts.store.usage)
        return Work(
            jobs=await self._parts.ledger.jobs_by_phase(),
            outbox=await self._parts.ledger.waiting(),
            store=StoreUse(files=usage.files, bytes=usage.bytes, quota=usage.quota),
        )
