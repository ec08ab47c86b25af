"""Coming back: an agent that was away, or whose state was restored from a backup, asks what has ended meanwhile.

The listener would find out too, but it reads the chain block by block, and by then a job that is paid already would be
played to the device again.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.chain import NoContracts, NodeUnreachable, NotALiability, RequestRefused
from mesh.outage_log import OutageLog
from mesh.work.lifecycle import Phase

if TYPE_CHECKING:
    from mesh.chain import Chain
    from mesh.work.ledger import Ledger
    from mesh.work.listener import ChainEventHandler

log = logging.getLogger(__name__)

RETRY: Final = 1.0
"""Seconds before a node is asked again that was lost, or that refused to answer."""
TO_BE_DONE: Final = (Phase.INCOMING, Phase.READY, Phase.RUNNING)


async def settle_ended(chain: Chain, ledger: Ledger, party: ChainEventHandler) -> None:
    """Tell the party of each job still to be done that has ended on the chain. A node that can't be reached is waited
    for; of a contract that the chain does not have any more, the listener tells."""
    trouble = OutageLog(log, "chain")
    for job in await ledger.jobs(TO_BE_DONE):
        address = job.liability.address
        while True:
            try:
                now = await chain.liabilities.get(address)
            except NotALiability:
                break
            except (NodeUnreachable, RequestRefused, NoContracts) as error:
                trouble.failed(error, "no job is gone on with before the chain can be asked, trying again")
                await asyncio.sleep(RETRY)
                continue
            trouble.recovered("the chain can be asked again")
            if now.is_finalized:
                await party.finalized(address, success=now.is_success, result=now.result)
            break
