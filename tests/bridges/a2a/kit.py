"""A door for the A2A project's conformance kit, run by hand: docs/guides/a2a.md has the results.

    python -m tests.bridges.a2a.kit            # prints its URL, until Ctrl-C
    ./run_tck.py --sut-host URL --level must   # in the kit's folder

The kit knows no token, and sends prose: what it expects is in the beginning of its message ids. So whatever it sends
gets the token here, and its prose becomes an order from a robot of a real market. Nothing else differs from `aira a2a`,
and nothing that comes back is touched.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from mesh.testing import Market
from tests.bridges.a2a.clients import serving
from tests.mesh.signer.signers import GOOD, LIMITS, Driver, Person, short_folder
from tests.support.doors import TOKEN

if TYPE_CHECKING:
    from mesh.base.asgi_server import AsgiApplication, Message, Receive, Send

TOPIC, VALUE = GOOD
MANY = LIMITS.replace("20 XRT", "200 XRT").replace("50 XRT", "500 XRT").replace("= 8", "= 100")
"""A budget for all that the kit orders."""


def translated(order: dict[str, Any], app: AsgiApplication) -> AsgiApplication:
    """The application for the kit: `order` is what its messages become."""

    async def serve(scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await app(scope, receive, send)
            return
        body, more = b"", True
        while more:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
        body = said(body, order)
        kept = [(name, value) for name, value in scope["headers"] if name != b"content-length"]
        given = [(b"authorization", f"Bearer {TOKEN}".encode()), (b"content-length", str(len(body)).encode())]
        parts = iter([{"type": "http.request", "body": body}])

        async def received() -> Message:
            return next(parts, None) or await receive()

        await app({**scope, "headers": kept + given}, received, send)

    return serve


def said(body: bytes, order: dict[str, Any]) -> bytes:
    """A request of the kit, whose prose is an order."""
    try:
        whole = json.loads(body)
        message = whole.get("params", whole)["message"]
        (text,) = [part for part in message["parts"] if set(part) == {"text"}]
    except (ValueError, TypeError, LookupError, AttributeError):
        return body
    kind = message.get("messageId", "")
    if not kind.startswith("tck-message-response"):
        del text["text"]
        text["data"] = order | {"cost": "1 XRT"}
        if kind.startswith("tck-input-required"):  # each is another task, that waits for a person's yes
            text["data"]["cost"] = "4 XRT"
            message["messageId"] = f"{kind}-{uuid4()}"
    return json.dumps(whole).encode()


async def main(port: int) -> None:
    """Serve until cancelled."""
    for folder in short_folder():
        driver = Driver(folder)
        async with (
            Market() as market,
            market.robot(driver.agent),
            Person(market, folder, market.chain.new_account()) as person,
        ):
            person.allow(driver.model, limits=MANY)
            order = {"model": driver.model, "messages": [{"topic": TOPIC, "value": VALUE}]}
            before = partial(translated, order)
            async with (
                person.at_work() as (_, _, signer),
                serving(signer.door, folder / "a2a", push_anywhere=True, port=port, wrap=before) as door,
            ):
                print(door.url, flush=True)
                await asyncio.Event().wait()


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        asyncio.run(main(int(sys.argv[1]) if sys.argv[1:] else 0))
