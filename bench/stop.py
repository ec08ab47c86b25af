"""How fast a stop reaches a board: from the customer's `stop()` until the pin of a simulated Uno falls.

The customer signs the request; it travels through a router to the agent, from there through the router to `aira edge`,
and over a serial line at 57,600 baud. Customer, router, agent, edge agent and board are a process each. It is measured
without other messages, and while another process puts `--rate` messages a second on the topics of the job, which the
agent records. `unheard` counts the stops that did not reach the pin within five seconds, or that no device confirmed.
The contracts are not on a chain: that would only make it slow. The bar: 250 ms for 99 % of the stops, none unheard.
"""

from __future__ import annotations

import asyncio
import secrets
import statistics
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import zenoh
from edge import LIBRARIES, edge
from msgspec.structs import replace

from bridges.serial import Device
from bridges.serial.boards import SimulatedBoard
from bridges.serial.firmware import compile_sketch
from common import SPAWN, arguments, process, router, show
from mesh import Agent
from mesh.agent.contracts import request_stop
from mesh.chain import Account, Chain
from mesh.dev import EmbeddedChain
from mesh.dev.development import deploy_market
from mesh.errors import AiraError
from mesh.network import Endpoints, Network
from mesh.recording import pack_values
from mesh.role.running import fail
from mesh.settings import Settings
from schemas import Empty, Liability, LiabilityTopicKey, Signer, cid_of_bytes, event_selector
from schemas.address import checksum_address
from schemas.keys import EventKey, parse_agent_key

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from mesh.agent.handlers import Job

SKETCH: Final = Path(__file__).parents[1] / "examples" / "firmware" / "AiraFrames" / "examples" / "Stop"
ROBOT_KEY: Final = b"\5" * 32
PIN: Final = 13
BAR_MS: Final = 250.0
TIMEOUT: Final = 120.0
HEARD_TIMEOUT: Final = 5.0


def main() -> None:
    """Measure and print; exit with 1 above the bar."""
    given = arguments(__doc__ or "", stops=200, rate=1000)
    with tempfile.TemporaryDirectory() as folder:
        results = measured(Path(folder), stops=given.stops, rate=given.rate)
    show(results, as_json=given.json)
    if any(one["p99_ms"] > BAR_MS or one["unheard"] for one in results.values()):
        sys.exit(f"the bar is {BAR_MS:g} ms for 99 % of the stops, and none unheard")


def measured(folder: Path, *, stops: int, rate: int) -> dict[str, dict[str, float]]:
    """The times of the stops, `alone` and `busy`."""
    elf = compile_sketch(SKETCH, folder / "stop.elf", libraries=[LIBRARIES])
    falls: list[float] = []
    fell, address = threading.Event(), Account(ROBOT_KEY).address

    def watch(line: str) -> None:
        if line.startswith(f"pin {PIN} 0"):
            falls.append(time.perf_counter())
            fell.set()

    robot, here = SPAWN.Pipe()
    with (
        router() as (endpoint, _),
        SimulatedBoard(elf, watch=watch) as board,
        edge(board.port, endpoint, address),
        process(serve_robot, endpoint, str(folder), robot),
    ):
        robot.close()  # the process has its own: when it ends, `here` ends
        expect(here, "ready")
        measure = partial(stop_jobs, endpoint, here, address, falls, fell, stops)
        results = {"alone": asyncio.run(measure())}
        with process(put_noise, endpoint, address, rate):
            results["busy"] = asyncio.run(measure())
    return results


async def stop_jobs(
    endpoint: str, robot: Connection, promisor: str, falls: list[float], fell: threading.Event, stops: int
) -> dict[str, float]:
    """Begin and stop that many jobs, one after the other."""
    customer, took, unheard = Signer(secrets.token_bytes(32)), [], 0
    async with Network(Endpoints(connect=(endpoint,))) as network:
        for _ in range(stops):
            liability = made_up(customer.address, promisor)
            await asyncio.to_thread(robot.send, liability.encode())
            await asyncio.to_thread(expect, robot, "moving")
            fell.clear()
            began = time.perf_counter()
            stopped = await request_stop(network.session, customer, liability, "bench")
            is_down = await asyncio.to_thread(fell.wait, HEARD_TIMEOUT)
            if is_down and stopped.devices and all(one.heard for one in stopped.devices):
                took.append((falls[-1] - began) * 1000)
            else:
                unheard += 1
            await asyncio.to_thread(expect, robot, "ended")
    if not took:
        raise AiraError(f"none of {stops} stops reached the pin", code="bench-failed")
    took.sort()
    return {
        "stops": stops,
        "p50_ms": round(statistics.median(took), 1),
        "p99_ms": round(took[min(len(took) - 1, int(len(took) * 0.99))], 1),
        "most_ms": round(took[-1], 1),
        "unheard": unheard,
    }


def expect(robot: Connection, word: str) -> None:
    """Wait until the robot's process says a word. Raises `AiraError` if it does not, or has ended."""
    try:
        said = robot.recv() if robot.poll(TIMEOUT) else f"nothing for {TIMEOUT:g} s"
    except EOFError:
        said = "nothing any more, it has ended"
    if said != word:
        raise AiraError(f"the robot's process should say {word!r}, but said {said}", code="bench-failed")


def made_up(promisee: str, promisor: str) -> Liability:
    """A liability that exists nowhere else; its objective is the one that the robot has."""
    return Liability.of_nobody(
        address=checksum_address(secrets.token_bytes(20)),
        model=cid_of_bytes(b"bench"),
        promisee=promisee,
        promisor=promisor,
    )


def serve_robot(endpoint: str, folder: str, pipe: Connection) -> None:
    """The robot's process: it does the jobs that come through the pipe."""
    asyncio.run(_serve_robot(endpoint, Path(folder), pipe))


async def _serve_robot(endpoint: str, folder: Path, pipe: Connection) -> None:
    async with EmbeddedChain() as node:
        market = await deploy_market(node.provider, node.funded_keys)
        settings = Settings(
            connect=(endpoint,),
            data_dir=str(folder / "robot"),
            lighthouse_contract=market.deployment.lighthouse_name,
            ens_contract=market.deployment.ens,
            playback="at-once",
        )
        account = Account(ROBOT_KEY)
        async with Chain(node.provider, account=account, contracts=market.deployment.contracts) as chain:
            robot = Agent(cid_of_bytes(b"bench"), settings=settings, account=account, chain=chain)
            device = Device(robot, patience=TIMEOUT)

            @robot.on("/work")
            async def work(job: Job, message: object) -> None:
                await device.call("/move", job=job)
                pipe.send("moving")
                await asyncio.Event().wait()

            async with robot:
                await _do_jobs(robot, folder / "objective.mcap", pipe)


async def _do_jobs(robot: Agent, path: Path, pipe: Connection) -> None:
    pack_values([("/work", Empty())], path)
    objective, (ledger, executor) = await robot.add(path), (robot.parts.ledger, robot.runtime.executor)
    await executor.wait_until_open()
    pipe.send("ready")
    while True:
        liability = replace(Liability.decode(await asyncio.to_thread(pipe.recv)), objective=objective)
        await ledger.add_job(liability)
        executor.prepare(liability)
        while (job := await ledger.job(liability.address)) is None or job.result is None:
            await asyncio.sleep(0.01)
        await robot.runtime.finalized(liability.address, success=False, result=job.result)  # as a contract would
        pipe.send("ended")


def put_noise(endpoint: str, agent: str, rate: int) -> None:
    """Put messages on a topic of the agent's present job, until terminated."""
    present: list[str] = []

    def note(sample: zenoh.Sample) -> None:
        key = parse_agent_key(str(sample.key_expr))
        if isinstance(key, EventKey):
            present[:] = [key.liability] if key.event == "ready" else []

    with zenoh.open(Endpoints(connect=(endpoint,)).config()) as session:
        subscriber: Any = session.declare_subscriber(event_selector(agent), note)
        due = time.monotonic()
        while subscriber is not None:
            for job in present[:1] or [agent]:
                session.put(str(LiabilityTopicKey(agent, job, "/noise")), b"7", encoding="application/json")
            due += 1 / rate
            time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    try:
        main()
    except AiraError as error:  # the AVR tools are missing: `make peers`
        fail(error)
