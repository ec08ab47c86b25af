"""Record what the peers send, as vectors: `python -m tests.bridges.ros2.record` writes `vectors/*.json` anew.

It listens with Zenoh alone, so that nothing of the bridge is in what the bridge is compared with.
"""

from __future__ import annotations

import asyncio
import json
import struct
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import zenoh

from tests.bridges.ros2.peers import VECTORS, client_config, hiroz, sdk
from tests.support.routers import EmbeddedRouter

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.bridges.ros2.peers import RosPeer

REQUEST = bytes.fromhex("00010000" + "0200000000000000" + "0300000000000000")
"""AddTwoInts of 2 and 3."""
ATTACHMENT = struct.pack("<qqB16s", 7, 1_700_000_000_000_000_000, 16, bytes(range(16)))
SAMPLES_OF_A_KEY = 3
ZENOH = version("eclipse-zenoh")


class Tap:
    """Hears all messages, requests and tokens of a domain."""

    def __init__(self, endpoint: str) -> None:
        self._session = zenoh.open(client_config(endpoint))
        self.heard: dict[str, list[dict[str, Any]]] = {"samples": [], "requests": [], "replies": []}
        self.tokens: set[str] = set()
        self._session.declare_subscriber("0/**", lambda sample: self._take("samples", sample))
        self._session.declare_queryable("0/**", self._query, complete=True)
        self._session.liveliness().declare_subscriber("@ros2_lv/**", self._token, history=True)

    def ask(self, key: str) -> None:
        """Send a request, and record the reply."""
        for reply in self._session.get(
            key, payload=REQUEST, attachment=ATTACHMENT, target=zenoh.QueryTarget.ALL, timeout=20.0
        ):
            if reply.ok is not None:
                self._take("replies", reply.ok)

    def key_of(self, part: str) -> str:
        """The key of the service whose token has `part` in it."""
        token = next(token for token in self.tokens if part in token and "/SS/" in token)
        name, kind, type_hash = token.split("/")[9:12]
        return f"0/{name.replace('%', '/').strip('/')}/{kind}/{type_hash}"

    def write(self, name: str, origin: str) -> None:
        """Write what was heard."""
        vectors = {"origin": origin, **self.heard, "tokens": sorted(self.tokens)}
        (VECTORS / name).write_text(json.dumps(vectors, indent=1) + "\n")
        self._session.close()  # type: ignore[no-untyped-call]

    def _token(self, sample: zenoh.Sample) -> None:
        self.tokens.add(str(sample.key_expr))

    def _query(self, query: zenoh.Query) -> None:
        self._take("requests", query)
        query.drop()  # type: ignore[no-untyped-call]

    def _take(self, what: str, heard: Any) -> None:
        key = str(heard.key_expr)
        taken = self.heard[what]
        if sum(one["key"] == key for one in taken) < SAMPLES_OF_A_KEY:
            payload, attachment = heard.payload, heard.attachment
            taken.append(
                {
                    "key": key,
                    "payload": payload.to_bytes().hex() if payload else "",
                    "attachment": attachment.to_bytes().hex() if attachment else "",
                }
            )


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
