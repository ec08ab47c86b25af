"""What the door adds: `aira mcp` over stdio and HTTP before a signer with a real market, against the signer alone.

Signer, chain, router and robot are in this process, each door is one of its own. An order is asked for again and again
by its key, so each answer is the same job: what differs is the way there.

- `signer_p50_ms`, `signer_p99_ms`: an order over the signer's own socket.
- `stdio_added_p50_ms` and so on: how much longer it takes over a door.
- `stdio_calls_s`, `http_calls_s`: calls a second that the door answers alone, eight at a time.
- `door_mb`: memory of a door after that.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import tempfile
import time
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mcp_types.version import LATEST_MODERN_VERSION

from common import arguments, router, show

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the doors of the tests

from mesh import Agent, Settings
from mesh.dev import EmbeddedChain
from mesh.dev.development import deploy_market
from mesh.signer.client import SignerClient
from mesh.signer.service import Signer
from schemas import cid_of_bytes
from tests.support.doors import TOKEN, door_process
from tests.support.mcp.clients import http_client, stdio_client

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from mcp import Client

MODEL: Final = cid_of_bytes(b"what the robot of the benchmark can do")
POLICY: Final = """\
[budget]
per_job = "5 XRT"
per_hour = "20 XRT"
per_day = "50 XRT"
[[allow]]
models = ["*"]
robots = ["*"]
[allow.topics."/blink"]
"""
AT_ONCE: Final = 8
MOST_P99: Final = 100.0
"""Milliseconds that a door may add to an order."""


def main() -> None:
    """Measure and print; exit with 1 above the bar."""
    given = arguments(__doc__ or "", orders=80, calls=1000)
    logging.disable(logging.WARNING)
    with router() as (endpoint, _), tempfile.TemporaryDirectory(prefix="aira-bench-") as folder:
        results = asyncio.run(measure(endpoint, Path(folder), given.orders, given.calls))
    show(results, as_json=given.json)
    if max(results["stdio_added_p99_ms"], results["http_added_p99_ms"]) > MOST_P99:
        raise SystemExit(f"a door adds more than {MOST_P99} ms")


async def measure(endpoint: str, folder: Path, orders: int, calls: int) -> dict[str, Any]:
    """The results."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        node = await enter(EmbeddedChain())
        market = await deploy_market(node.provider, node.funded_keys)
        policy = folder / "policy.toml"
        policy.write_text(POLICY)
        policy.chmod(0o600)
        settings = Settings(
            connect=(endpoint,),
            data_dir=str(folder),
            lighthouse_contract=market.deployment.lighthouse_name,
            ens_contract=market.deployment.ens,
        )
        chain = await enter(market.chain(node.provider, "person"))
        robot_chain = await enter(market.chain(node.provider, "robot"))
        await enter(Agent(MODEL, settings=settings, account=market.accounts["robot"], chain=robot_chain))
        signer = await enter(Signer(settings, policy, account=market.accounts["person"], chain=chain))
        direct = await enter(SignerClient(signer.door))
        order = {
            "model": MODEL,
            "messages": [{"topic": "/blink", "value": None}],
            "cost": "1 XRT",
            "idempotency_key": "one",
        }
        results: dict[str, Any] = {"orders": orders, "calls": calls}
        alone = await times(orders, lambda: direct.ask("order", order))
        results |= {f"signer_{name}_ms": value for name, value in percentiles(alone).items()}
        for name, door in (("stdio", over_stdio), ("http", over_http)):
            async with door(signer.door, folder) as (client, pid):
                took = await times(orders, lambda client=client: client.call_tool("order", order))  # type: ignore[misc]
                added = percentiles(took)
                for part, value in percentiles(alone).items():
                    results[f"{name}_added_{part}_ms"] = round(added[part] - value, 2)
                results[f"{name}_calls_s"] = round(await rate(calls, client))
                results["door_mb"] = max(results.get("door_mb", 0), memory(pid))
    return results


async def times(count: int, call: Callable[[], Awaitable[Any]]) -> list[float]:
    """How long each of so many calls takes, seconds; a tenth of them before is not counted."""
    found = []
    for number in range(count + count // 10):
        begin = time.perf_counter()
        result = await call()
        if number >= count // 10:
            found.append(time.perf_counter() - begin)
        assert not getattr(result, "is_error", False), result
    return found


def percentiles(found: list[float]) -> dict[str, float]:
    """In milliseconds."""
    ordered = sorted(found)
    return {f"p{part}": round(1000 * ordered[len(ordered) * part // 100], 2) for part in (50, 99)}


async def rate(count: int, client: Client) -> float:
    """Calls a second, some at a time, which the door refuses itself: the signer takes 30 a second."""
    left = iter(range(count))

    async def ask() -> None:
        for _ in left:
            await client.list_resource_templates()
            result = await client.call_tool("job", {"job_id": "no job"})
            assert result.is_error

    begin = time.perf_counter()
    await asyncio.gather(*(ask() for _ in range(AT_ONCE)))
    return 2 * count / (time.perf_counter() - begin)


def memory(pid: int) -> int:
    """The memory of a process, MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return round(int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024)


@asynccontextmanager
async def over_stdio(socket: Path, folder: Path) -> AsyncIterator[tuple[Client, int]]:
    """A door that the client starts, and its process id."""
    pid = folder / "pid"
    options = ("--socket", str(socket), "--log-level", "error")
    async with stdio_client(*options, version=LATEST_MODERN_VERSION, pid_file=pid) as client:
        yield client, int(pid.read_text())


@asynccontextmanager
async def over_http(socket: Path, folder: Path) -> AsyncIterator[tuple[Client, int]]:
    """A door that listens, and its process id."""
    async with (
        door_process("mcp", socket, folder / "http", "--log-level", "error") as door,
        http_client(door.url, TOKEN, LATEST_MODERN_VERSION) as client,
    ):
        yield client, door.pid


if __name__ == "__main__":
    main()
