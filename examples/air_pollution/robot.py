"""Air pollution sensor: answers each Demand that pays nothing with its next measurement, without a contract."""

import tempfile
from pathlib import Path

from bridges.serial import Device
from mesh import STRING, Agent, Demand, Recorder, RecordingAbout, Result, String, Verified, cid_of_file

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))
board = Device(agent)
waiting: list[Verified[Demand]] = []


@agent.every(1.0)
async def listen() -> None:
    """Answer all waiting demands with each measurement. `every` starts this again should it end."""
    async with board.listen("/measurements") as measurements:
        print("listening to the board", flush=True)
        async for text in measurements:
            if waiting and isinstance(text, String):
                cid = await record(text)
                while waiting:
                    answer(waiting.pop().signer, cid)


@agent.on_demand
async def take(demand: Verified[Demand]) -> None:
    if not demand.message.cost:  # one that pays needs a contract, as in the other examples
        waiting.append(demand)


def answer(asker: str, cid: str) -> None:
    """Publish a Result without a contract: it names the asker's address as its liability."""
    agent.send(Result(liability=asker, result=cid, success=True))
    print(f"answered {asker}: {cid}", flush=True)


async def record(text: String) -> str:
    """Put a recording with one measurement into the store; returns its CID."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "measurement.mcap"
        with Recorder(path, RecordingAbout(agent=agent.address)) as recorder:
            recorder.record("/measurements", text.encode(), STRING, role="device")
        return await agent.add(path)


if __name__ == "__main__":
    agent.run()
