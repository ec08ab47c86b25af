"""Services for tests."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from mesh.network import Services
from schemas import RpcKey
from schemas.rpc import Done, LiabilityRequest
from tests.support.orders import LIGHTHOUSE, ROBOT
from tests.support.waiting import until_answered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from schemas import Record

ADDRESS = ROBOT.address
REQUEST = LiabilityRequest(LIGHTHOUSE)


@asynccontextmanager
async def offering(there: zenoh.Session, here: zenoh.Session, **handlers: Any) -> AsyncIterator[Services]:
    """Services of the agent `there`, already visible `here`."""
    async with asyncio.timeout(60), Services(there, ADDRESS) as services:
        for name, handler in handlers.items():
            services.offer(name.replace("__", "/"), handler)
            await until_answered(here, str(RpcKey(ADDRESS, name.replace("__", "/"))))
        yield services


async def done(request: Record) -> Done:
    return Done(True, str(request))
