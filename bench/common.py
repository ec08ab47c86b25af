"""What the benchmarks share: signed messages, a router process, command line options and output."""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import secrets
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mesh.network import Endpoints, Network, free_endpoint
from schemas import ZERO_ADDRESS, Demand, Signer, cid_of_digest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

SPAWN: Final = multiprocessing.get_context("spawn")
LIGHTHOUSE: Final = "airalab.lighthouse.3.robonomics.eth"
ADDRESS: Final = "0x" + "11" * 20
TOKEN: Final = "0x" + "22" * 20
MODEL: Final = cid_of_digest(bytes(32))


def unsigned_demands(
    count: int, *, deadline: int = 10**9, lighthouse: str = ADDRESS, cost: int = 1000
) -> Iterator[Demand]:
    """Demands for one model that differ in objective and nonce. The legacy network takes them, too."""
    for _ in range(count):
        yield Demand(
            model=MODEL,
            objective=cid_of_digest(secrets.token_bytes(32)),
            token=TOKEN,
            cost=cost,
            lighthouse=lighthouse,
            validator=ZERO_ADDRESS,
            validator_fee=0,
            deadline=deadline,
            nonce=secrets.token_hex(32),
        )


def signed_demands(count: int, *, lighthouse: str = ADDRESS, cost: int = 1000) -> list[Demand]:
    """The same demands, each signed by one of sixteen people."""
    people = [Signer(secrets.token_bytes(32)) for _ in range(16)]
    demands = unsigned_demands(count, lighthouse=lighthouse, cost=cost)
    return [people[number % 16].sign(demand) for number, demand in enumerate(demands)]


def installed_anvil() -> Path | None:
    """The anvil that `make peers` installed; None if there is none, and then the embedded chain serves."""
    from peers.catalog import PeerMissing, locate  # of the checkout, whose folder the caller puts on the path

    try:
        return locate("anvil")
    except PeerMissing:
        return None


@contextmanager
def router() -> Iterator[tuple[str, int]]:
    """A router in a process of its own: its endpoint and its process id."""
    endpoint = free_endpoint()
    process = SPAWN.Process(target=_route, args=(endpoint,), daemon=True)
    process.start()
    assert process.pid is not None
    try:
        yield endpoint, process.pid
    finally:
        process.terminate()
        process.join()


@contextmanager
def process(target: Callable[..., None], *given: Any) -> Iterator[None]:
    """Meanwhile run a function in a process of its own."""
    running = SPAWN.Process(target=target, args=given, daemon=True)
    running.start()
    try:
        yield
    finally:
        running.terminate()
        running.join()


def _route(endpoint: str) -> None:
    asyncio.run(_run_router(endpoint))


async def _run_router(endpoint: str) -> None:
    async with Network(Endpoints(listen=(endpoint,), mode="router")):
        await asyncio.Event().wait()


def arguments(description: str, **defaults: int | tuple[str, ...]) -> argparse.Namespace:
    """The command line options: `--json`, and for each of `defaults` a number, one of several words, or a flag."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    for name, default in defaults.items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(default, bool):
            parser.add_argument(option, action="store_true")
        elif isinstance(default, tuple):
            parser.add_argument(option, choices=default, default=default[0])
        else:
            parser.add_argument(option, type=int, default=default)
    return parser.parse_args()


def show(results: dict[str, Any], *, as_json: bool) -> None:
    """Print the results."""
    if as_json:
        print(json.dumps(results))
        return
    width = max(len(name) for name in results)
    for name, value in results.items():
        print(f"{name.replace('_', ' '):<{width}}  {value}")
