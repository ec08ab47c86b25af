"""Record what the peers send, as vectors: `python -m tests.support.ros2.record` writes `vectors/*.json` again."""

from __future__ import annotations

import asyncio
from importlib.metadata import version
from typing import TYPE_CHECKING

from tests.support.ros2.peers import hiroz, sdk
from tests.support.ros2.tap import Tap
from tests.support.routers import EmbeddedRouter

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.ros2.peers import RosPeer

ZENOH = version("eclipse-zenoh")


async def record(name: str, origin: str, peer: Callable[..., RosPeer], client: str, *roles: str) -> None:
    """Start the roles and then the client, and write what they send."""
    with EmbeddedRouter() as router:
        tap = await asyncio.to_thread(Tap, router.endpoint)
        running = [
            await peer(role, router.endpoint, node=f"peer_{role}".replace("-", "_")).__aenter__() for role in roles
        ]
        async with peer(client, router.endpoint, a=2, b=3, order=4) as last:
            await last.rest()
        await asyncio.to_thread(tap.ask, tap.key_of("add_two_ints"))
        await asyncio.to_thread(tap.write, name, origin)
        for one in running:
            await one.__aexit__()


async def main() -> None:
    """Record all peers."""
    roles = ("talker", "add-server", "fibonacci-server", "parameters")
    for distribution in ("jazzy", "humble"):

        def peer(role: str, endpoint: str, distribution: str = distribution, **options: object) -> RosPeer:
            return hiroz(role, endpoint, distribution=distribution, **options)

        origin = f"crates hiroz and hiroz-msgs 0.2.1, feature {distribution}, heard with eclipse-zenoh {ZENOH}"
        await record(f"hiroz-{distribution}.json", origin, peer, "fibonacci-client", *roles)
    origin = f"PyPI zenoh-ros2-sdk 0.1.8, heard with eclipse-zenoh {ZENOH}"
    await record("zenoh-ros2-sdk.json", origin, sdk, "add-client", "talker", "add-server")


if __name__ == "__main__":
    asyncio.run(main())
