"""The RPC of a Kubo of 2026, answer for answer, where it differs from older ones.

After `core/commands/pubsub.go`, `cmd/ipfs/kubo/daemon.go` and `commands/http` of its RPC library: POST only; topics and
data in base64url behind a `u`; published data is a file; browsers and who lacks a listed `Authorization` get 403 as
plain text. Since 0.40 a message whose number is checked after a higher one is refused with `validation ignored`.
"""

from __future__ import annotations

import asyncio
import json
from base64 import urlsafe_b64decode, urlsafe_b64encode
from typing import TYPE_CHECKING

from aiohttp import web

from tests.bridges.ipfs.old_daemon import OldDaemon

if TYPE_CHECKING:
    from aiohttp.typedefs import Handler

DENIED = (
    "Kubo RPC Access Denied: Please provide a valid authorization token as defined in the API.Authorizations "
    "configuration."
)
NOT_ENABLED = "experimental pubsub feature not enabled, run daemon with --enable-pubsub-experiment to use"


class RecentDaemon(OldDaemon):
    """As `OldDaemon`, of today. `slow` seconds lie between a message's number and its check."""

    version = "0.44.0"
    disabled = NOT_ENABLED

    def __init__(self, *, pubsub: bool = True, authorization: str = "", slow: float = 0.0) -> None:
        super().__init__(pubsub=pubsub, authorization=authorization)
        self.slow = slow
        self.overtaken = 0
        self._highest = 0

    def event(self, topic: str, data: bytes, sender: OldDaemon, sequence: int) -> dict[str, object]:
        return {
            "from": sender.peer_id,
            "data": multibase(data),
            "seqno": multibase(sequence.to_bytes(8, "big")),
            "topicIDs": [multibase(topic.encode())],
        }

    def topic_of(self, request: web.Request) -> str:
        (text,) = request.query.getall("arg")
        if not text.startswith("u"):
            raise web.HTTPInternalServerError(text=refusal("URL arg must be base64url encoded"))
        return urlsafe_b64decode(text[1:] + "=" * (-len(text[1:]) % 4)).decode()

    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.method != "POST":
            return web.Response(status=405, text="405 - Method Not Allowed\n")
        if (
            request.headers.get("User-Agent", "").startswith("Mozilla")
            or {"Origin", "Referer"} & request.headers.keys()
        ):
            return web.Response(status=403, text="403 - Forbidden\n")
        if self._authorization and request.headers.get("Authorization") != self._authorization:
            return web.Response(status=403, text=f"{DENIED}\n")
        return await self.answer(request, handler)

    async def _pub(self, request: web.Request) -> web.StreamResponse:
        topic = self.topic_of(request)
        part = await (await request.multipart()).next()
        data = await part.read()  # type: ignore[union-attr]
        sequence = next(self._sequence)
        # Those that come together are checked in the wrong order.
        await asyncio.sleep(self.slow * (sequence % 2))
        if sequence <= self._highest:
            self.overtaken += 1
            return self._refuse("validation ignored")
        self._highest = sequence
        for daemon in (self, *self.others):
            daemon.deliver(topic, bytes(data), self, sequence)
        return web.Response(text="", content_type="text/plain")


def multibase(data: bytes) -> str:
    """As today's daemons write bytes."""
    return "u" + urlsafe_b64encode(data).decode().rstrip("=")


def refusal(why: str) -> str:
    """The body of an error."""
    return json.dumps({"Message": why, "Code": 0, "Type": "error"})
