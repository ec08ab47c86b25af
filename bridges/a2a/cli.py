"""`aira a2a`: the door for agents that speak A2A."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import click

from bridges.serving import DoorOptions, door_fields, door_socket, served_door, with_door
from mesh.base.extras import needs_extra
from mesh.base.private_files import held_alone
from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.errors import ConfigurationError
from mesh.role.running import run_until_stopped
from mesh.settings import StorageSettings

if TYPE_CHECKING:
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("a2a", short_help="let other agents hire robots, within your policy (A2A)")
@click.option("--http", default="127.0.0.1:8780", show_default=True, metavar="HOST:PORT", help="address to listen on")
@with_door("a2a")
@click.option("--robot", default="", metavar="ADDRESS", help="the one robot that is hired [any of the market]")
@click.option("--push-anywhere", is_flag=True, help="push notifications also into private networks, without TLS")
@with_settings(StorageSettings, "log_level", "log_format")
def command(settings: Settings, **options: Any) -> None:
    """Serve a door to the market for agents that speak A2A 1.0: an order is a task, its recording an artifact.

    The door has no key of yours: orders are signed by `aira signer`, within its policy. Clients need the token. The
    agent card is public, and signed with a key that the door makes for itself.
    """
    run_until_stopped(lambda: _serve(settings, options), settings=settings, role="a2a")


async def _serve(settings: Settings, options: dict[str, Any]) -> None:
    with needs_extra("a2a", "aira a2a"):
        from bridges.a2a._card import Card, CardKey
        from bridges.a2a._door import A2aDoor, application
        from bridges.a2a._push import Pusher, TaskStore
        from mesh.signer.client import SignerClient
    from schemas import parse_address

    robot = parse_address(options["robot"]) if options["robot"] else ""
    state = settings.state_directory
    chosen = DoorOptions(**await asyncio.to_thread(door_fields, "a2a", settings, options))
    key = await asyncio.to_thread(CardKey, state / "a2a-card-key.pem")
    store = TaskStore(state / "a2a.sqlite")
    running = ConfigurationError(
        "another `aira a2a` runs with this data folder",
        hint="stop that one, or name another folder with --data-dir, and the signer's with --socket",
        code="door-running",
    )
    async with AsyncExitStack() as stack:
        stack.enter_context(held_alone(state / "a2a.lock", running))
        signer = await stack.enter_async_context(SignerClient(door_socket(settings, options)))
        store.open()
        stack.callback(store.close)
        pusher = await stack.enter_async_context(Pusher(signer, store, anywhere=options["push_anywhere"]))
        card = Card(signer, key, robot=robot)
        app = application(A2aDoor(signer, store, pusher, robot=robot), card, key, chosen)
        url = await stack.enter_async_context(served_door(app, chosen))
        card.url = chosen.url.rstrip("/") or url
        announce(log, "a2a-started", f"a2a         {card.url}", url=card.url)
        await asyncio.Event().wait()
