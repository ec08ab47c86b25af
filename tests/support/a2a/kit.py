"""A door for the A2A project's conformance kit, run by hand: docs/guides/a2a.md has the results.

    python -m tests.support.a2a.kit            # prints its URL, until Ctrl-C
    python -m tests.support.a2a.kit --script   # with the agent of the kit's scenarios in place of the market
    ./run_tck.py --sut-host URL --level must   # in the kit's folder

The kit knows no token, and sends prose: what it expects is in the beginning of its message ids. So whatever it sends
gets the token here, and its prose becomes an order from a robot of a real market. A task that is to wait for input
waits for a person's yes, and that state has the name that the kit looks for; the message that completes the task is the
yes, and the order sent again. Nothing else differs from `aira a2a`, and nothing that comes back is touched.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final
from unittest.mock import patch
from uuid import uuid4

import httpx
from a2a.helpers import new_task_from_user_message, new_text_message
from a2a.server.agent_execution import AgentExecutor
from a2a.server.request_handlers import DefaultRequestHandler
from a2a.server.tasks import (
    BasePushNotificationSender,
    InMemoryPushNotificationConfigStore,
    InMemoryTaskStore,
    TaskUpdater,
)
from a2a.types import AgentCapabilities, AgentCard, Part, TaskState
from google.protobuf.json_format import ParseDict

from bridges.a2a._tasks import STATES
from mesh.testing import Market
from tests.support.a2a.clients import NOWHERE, serving
from tests.support.doors import TOKEN
from tests.support.signer.signers import GOOD, LIMITS, Driver, Person, short_folder

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from a2a.server.agent_execution import RequestContext
    from a2a.server.events import EventQueue

    from mesh.base.asgi_server import AsgiApplication, Message, Receive, Send
    from mesh.signer.client import SignerClient
    from tests.support.a2a.clients import Served

TOPIC, VALUE = GOOD
MANY = LIMITS.replace("20 XRT", "200 XRT").replace("50 XRT", "500 XRT").replace("= 8", "= 100")
"""A budget for all that the kit orders."""
FILE: Final = {"filename": "output.txt", "mediaType": "text/plain"}
ARTIFACTS: Final[dict[str, dict[str, Any]]] = {
    "tck-artifact-text": {"text": "Generated text content"},
    "tck-artifact-file-url": {"url": "https://example.com/output.txt", **FILE},
    "tck-artifact-file": {"raw": "dGNr", **FILE},
    "tck-artifact-data": {"data": {"key": "value", "count": 42}},
    "tck-stream": {"text": "streamed"},
}
"""The part that the script makes for messages whose ids begin so; the first that fits."""


def admitted(app: AsgiApplication, translate: Callable[[bytes], Awaitable[bytes]] | None = None) -> AsgiApplication:
    """The application for the kit: its requests have the token, and a body that is translated."""

    async def serve(scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await app(scope, receive, send)
            return
        body, more = b"", True
        while more:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
        body = body if translate is None else await translate(body)
        kept = [(name, value) for name, value in scope["headers"] if name != b"content-length"]
        given = [(b"authorization", f"Bearer {TOKEN}".encode()), (b"content-length", str(len(body)).encode())]
        parts = iter([{"type": "http.request", "body": body}])

        async def received() -> Message:
            return next(parts, None) or await receive()

        await app({**scope, "headers": kept + given}, received, send)

    return serve


async def as_order(order: dict[str, Any], signer: SignerClient, owner: SignerClient, body: bytes) -> bytes:
    """A request of the kit, whose prose is an order."""
    try:
        whole = json.loads(body)
        message = whole.get("params", whole)["message"]
        (text,) = [part for part in message["parts"] if set(part) == {"text"}]
    except (ValueError, TypeError, LookupError, AttributeError):
        return body
    kind = message.get("messageId", "")
    if kind.startswith("tck-message-response"):
        return body
    del text["text"]
    text["data"] = order | {"cost": "1 XRT"}
    if kind.startswith("tck-input-required"):  # each is another task, that waits for a person's yes
        message["messageId"] = f"{kind}-{uuid4()}"
        text["data"] |= {"cost": "4 XRT", "note": message["messageId"]}
    elif kind.startswith("tck-complete-task") and "taskId" in message:
        job = await signer.job(message.pop("taskId"))
        if job.consent is not None:
            await owner.approve(job.consent.id)
        message["messageId"] = job.note
        text["data"] |= {"cost": "4 XRT", "note": job.note}
    return json.dumps(whole).encode()


@asynccontextmanager
async def hiring(port: int) -> AsyncIterator[Served]:
    """The door of a real market."""
    waits = {"needs-consent": (TaskState.TASK_STATE_INPUT_REQUIRED, STATES["needs-consent"][1])}
    for folder in short_folder():
        driver = Driver(folder)
        async with (
            Market() as market,
            market.robot(driver.agent),
            Person(market, folder, market.chain.new_account()) as person,
        ):
            person.allow(driver.model, limits=MANY)
            order = {"model": driver.model, "messages": [{"topic": TOPIC, "value": VALUE}]}
            async with person.at_work() as (client, owner, signer):
                before = partial(admitted, translate=partial(as_order, order, client, owner))
                opened = serving(signer.door, folder / "a2a", push_anywhere=True, port=port, wrap=before)
                with patch.dict(STATES, waits):
                    async with opened as door:
                        yield door


class Script(AgentExecutor):
    """The agent of the kit's scenarios, as far as its checks look."""

    async def execute(self, context: RequestContext, event_queue: EventQueue) -> None:
        """Do what the beginning of a message's id wants."""
        asked = context.message
        assert asked is not None
        if asked.message_id.startswith("tck-message-response"):
            await event_queue.enqueue_event(new_text_message("Direct message response"))
            return
        if context.current_task is None:
            await event_queue.enqueue_event(new_task_from_user_message(asked))
        task = TaskUpdater(event_queue, str(context.task_id), str(context.context_id))
        if asked.message_id.startswith("tck-input-required"):
            await task.requires_input()
            return
        await task.start_work()
        for part in [part for kind, part in ARTIFACTS.items() if asked.message_id.startswith(kind)][:1]:
            await task.add_artifact([ParseDict(part, Part())])
        await task.complete()

    async def cancel(self, context: RequestContext, event_queue: EventQueue) -> None:
        """Cancel a task."""
        await TaskUpdater(event_queue, str(context.task_id), str(context.context_id)).cancel()


@asynccontextmanager
async def scripted(port: int) -> AsyncIterator[Served]:
    """The front of the door (HTTP, token, card), with the SDK's own handler of tasks and the script behind it."""
    able = AgentCard(
        capabilities=AgentCapabilities(streaming=True, push_notifications=True),
        default_input_modes=["application/json", "text/plain"],
    )
    pushes = InMemoryPushNotificationConfigStore()
    with TemporaryDirectory() as folder:
        async with httpx.AsyncClient() as http:
            handler = DefaultRequestHandler(
                Script(),
                InMemoryTaskStore(),
                able,
                push_config_store=pushes,
                push_sender=BasePushNotificationSender(http, pushes),
                validate_input_modes=True,
            )
            async with serving(NOWHERE, Path(folder), port=port, wrap=admitted, handler=handler) as door:
                yield door
            await handler.aclose()


async def main(*options: str) -> None:
    """Serve until SIGINT or SIGTERM."""
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    ports = [int(option) for option in options if option != "--script"]
    async with (scripted if "--script" in options else hiring)(*ports or [0]) as door:
        print(door.url, flush=True)
        await stopped.wait()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
