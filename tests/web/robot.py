"""A robot whose model has a description: it drives, and publishes its position, texts and pictures."""

from __future__ import annotations

import asyncio
import math
import os
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

from mesh import Agent, Demand, Job, JobFailed, QuoteRequest, Verified, cid_of_file

STEPS = 20


def picture(shade: int) -> bytes:
    """A PNG of 64 by 48 pixels."""
    rows = b"".join(
        b"\0" + bytes((x * 4 % 256, y * 5 % 256, shade)[c] for x in range(64) for c in range(3)) for y in range(48)
    )
    head = struct.pack(">IIBBBBB", 64, 48, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    framed = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


model = Path(sys.argv[1])
agent = Agent(cid_of_file(model))
said = sys.argv[2] if len(sys.argv) > 2 else "drove"


PRICE = os.environ.get("ROBOT_PRICE", "")
if PRICE:

    @agent.on_quote
    async def quote(_request: QuoteRequest) -> str:
        return PRICE


@agent.on_demand
async def offer(demand: Verified[Demand]) -> None:
    await agent.offer(demand)


@agent.on("/drive", dict)
async def drive(job: Job, order: dict[str, Any]) -> None:
    """Drive a circle of that radius."""
    if order["direction"] == "into the wall":
        raise JobFailed("there is a wall")
    for step in range(STEPS):
        angle = 2 * math.pi * step / STEPS
        job.publish("/position", {"x": order["metres"] * math.cos(angle), "y": order["metres"] * math.sin(angle)})
        if step % 7 == 0:
            job.publish("/camera", picture(step * 12))
        await asyncio.sleep(order["seconds"] / STEPS)
    job.publish("/said", said)


async def main() -> None:
    async with agent:
        for file in (model, *map(Path, sys.argv[3:])):
            await agent.add(file)
        print(f"robot {agent.address}", flush=True)
        while os.environ.get("ROBOT_READS"):
            agent.publish("/battery", round(80 + 10 * math.sin(asyncio.get_running_loop().time() / 5), 1))
            await asyncio.sleep(0.25)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
