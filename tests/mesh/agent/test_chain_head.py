"""How far an agent has handled the chain."""

from __future__ import annotations

import asyncio

from mesh.agent.components import ChainHead


async def test_the_next_block_is_waited_for_also_when_the_position_is_ahead_of_the_head_first_read() -> None:
    head = ChainHead(5)
    head.begin_after(6)
    waiting = asyncio.create_task(head.reached(head.head + 1))
    await asyncio.sleep(0)
    assert not waiting.done()
    head.advance_to(7)
    await waiting
