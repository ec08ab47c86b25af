"""The door in this process, and the SDK's own client of it."""

from __future__ import annotations

import uuid
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
from a2a.client import ClientConfig, ClientFactory
from a2a.types import Message, Role, SendMessageRequest, StreamResponse
from google.protobuf.json_format import ParseDict

from bridges.a2a._card import Card, CardKey
from bridges.a2a._door import A2aDoor, application
from bridges.a2a._push import Pusher, TaskStore
from bridges.serving import DoorOptions
from mesh.base.asgi_server import AsgiServer
from mesh.base.door import DoorLimits
from mesh.signer.client import SignerClient
from tests.support.doors import TOKEN, door_process

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Callable

    from a2a.client import Client
    from a2a.server.request_handlers import RequestHandler
    from a2a.types import Task

    from mesh.base.asgi_server import AsgiApplication

NOWHERE = Path("/nowhere/door.sock")
"""Where no signer is."""
CALL = {"jsonrpc": "2.0", "id": 1, "method": "GetTask", "params": {"id": "job-0000000000000000"}}
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}", "A2A-Version": "1.0", "Content-Type": "application/json"}


@dataclass
class Reached:
    """A door that is served somewhere."""

    url: str

    @asynccontextmanager
    async def client(
        self, *, streaming: bool = True, binding: str = "JSONRPC", verify: ssl.SSLContext | bool = True
    ) -> AsyncIterator[Client]:
        async with httpx.AsyncClient(headers={"Authorization": f"Bearer {TOKEN}"}, timeout=90, verify=verify) as http:
            config = ClientConfig(httpx_client=http, streaming=streaming, supported_protocol_bindings=[binding])
            yield await ClientFactory(config).create_from_url(self.url)


@dataclass
class Served(Reached):
    """A door that is served in this process."""

    key: CardKey
    pusher: Pusher


@asynccontextmanager
async def process(socket: Path, state: Path, *options: str) -> AsyncIterator[Reached]:
    """`aira a2a` in a process of its own, which is killed in the end."""
    async with door_process("a2a", socket, state, *options) as door:
        yield Reached(door.url)


@asynccontextmanager
async def serving(
    socket: Path,
    state: Path,
    *,
    robot: str = "",
    push_anywhere: bool = False,
    names: tuple[str, ...] = (),
    limits: DoorLimits = DoorLimits(),  # noqa: B008
    port: int = 0,
    wrap: Callable[[AsgiApplication], AsgiApplication] = lambda app: app,
    handler: RequestHandler | None = None,
) -> AsyncIterator[Served]:
    """The door of the signer on a socket, which keeps its state in a folder; `wrap` stands before it, and a `handler`
    takes the place of all that is behind HTTP."""
    async with AsyncExitStack() as stack:
        signer = await stack.enter_async_context(SignerClient(socket))
        key, store = CardKey(state / "key.pem"), TaskStore(state / "a2a.sqlite")
        store.open()
        stack.callback(store.close)
        pusher = await stack.enter_async_context(Pusher(signer, store, anywhere=push_anywhere))
        door = handler or A2aDoor(signer, store, pusher, robot=robot)
        card = Card(signer, key, robot=robot)
        app = application(door, card, key, DoorOptions(token=TOKEN, names=names))
        server = await stack.enter_async_context(AsgiServer(wrap(app), "127.0.0.1", port, limits=limits))
        card.url = server.url
        yield Served(server.url, key, pusher)


def request(data: dict[str, Any], *, message_id: str = "", context: str = "") -> SendMessageRequest:
    """A message with one data part."""
    message = Message(message_id=message_id or str(uuid.uuid4()), role=Role.ROLE_USER, context_id=context)
    ParseDict({"parts": [{"data": data}]}, message)
    return SendMessageRequest(message=message)


async def sent(client: Client, asked: SendMessageRequest) -> list[StreamResponse]:
    """All that a client gets for a message."""
    return [one async for one in client.send_message(asked)]


def job_of(task: Task) -> dict[str, Any]:
    """What the metadata of a task say of its job."""
    from google.protobuf.json_format import MessageToDict

    found: dict[str, Any] = MessageToDict(task.metadata)["job"]
    return found
