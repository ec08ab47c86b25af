"""Air pollution sensor: answers who asks for nothing with what it measures now. The Result needs no contract."""

import asyncio
import tempfile
from pathlib import Path

from bridges.serial import Device
from mesh import Agent
from mesh.recording import Recorder, RecordingAbout
from schemas import STRING, Demand, Result, String, Verified, cid_of_file

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))
board = Device(agent)
waiting: list[Verified[Demand]] = []


@agent.every(1.0)
async def listen() -> None:
    """Tell the next measurement to all who have asked; begun anew should the listening end."""
    async with board.listen("/measurements") as measurements:
        print("listening to the board", flush=True)
        async for text in measurements:
            if waiting and isinstance(text, String):
                cid = await asyncio.to_thread(record, text)
                while waiting:
                    tell(waiting.pop().signer, cid)


@agent.on_demand
async def take(demand: Verified[Demand]) -> None:
    if not demand.message.cost:  # a paid one wants a contract, which is another lesson
        waiting.append(demand)


def tell(asker: str, cid: str) -> None:
    """A Result without a contract: its liability is the asker's address."""
    agent.channel.publish(agent.parts.signer.sign(Result(liability=asker, result=cid, success=True)))
    print(f"told {asker}: {cid}", flush=True)


def record(text: String) -> str:
    """A recording with one measurement, in the store; returns its CID."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "measurement.mcap"
        with Recorder(path, RecordingAbout(agent=agent.address)) as recorder:
            recorder.record("/measurements", text.encode(), STRING, role="device")
        return agent.parts.store.put_file(path)


if __name__ == "__main__":
    agent.run()
