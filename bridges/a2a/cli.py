"""`aira a2a`: the door for agents that speak A2A."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.base.extras import needs_extra
from mesh.cli.options import FILE, with_settings
from mesh.cli.output import announce
from mesh.role.running import run_until_stopped
from mesh.settings import StorageSettings

if TYPE_CHECKING:
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("a2a", short_help="let other agents hire robots, within your policy (A2A)")
@click.option("--socket", type=click.Path(path_type=Path), help="door.sock of the signer [in its state folder]")
@click.option("--http", default="127.0.0.1:8780", show_default=True, metavar="HOST:PORT", help="address to listen on")
@click.option("--url", default="", metavar="URL", help="this server's URL as clients know it [of --http]")
@click.option("--robot", default="", metavar="ADDRESS", help="the one robot that is hired [any of the market]")
@click.option("--certificate", type=FILE, help="certificate of this server for HTTPS (PEM)")
@click.option("--key", type=FILE, help="key of the certificate (PEM)")
@click.option(
    "--token-file", type=FILE, help="private file with the token of clients, made if missing [data_dir/a2a-token]"
)
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
        from bridges.a2a._door import A2aDoor
        from bridges.a2a._http import A2aOptions, application
        from bridges.a2a._push import Pusher
        from bridges.a2a._store import TaskStore
        from mesh.base.asgi_server import AsgiServer
        from mesh.signer.client import SignerClient
    from bridges.web.access import server_tls
    from mesh.base.private_files import private_token
    from mesh.signer.protocol import DOOR_SOCKET, signer_folder
    from mesh.telemetry.metrics import listen_address
    from schemas import parse_address

    host, port = listen_address(options["http"])
    robot = parse_address(options["robot"]) if options["robot"] else ""
    state = settings.state_directory
    chosen = A2aOptions(
        host=host,
        port=port,
        certificate=str(options["certificate"] or ""),
        key=str(options["key"] or ""),
        token=await asyncio.to_thread(private_token, options["token_file"] or state / "a2a-token"),
    )
    chosen.check()
    tls = server_tls(chosen.certificate, chosen.key) if chosen.certificate else None
    key = await asyncio.to_thread(CardKey, state / "a2a-card-key.pem")
    store = TaskStore(state / "a2a.sqlite")
    async with AsyncExitStack() as stack:
        signer = await stack.enter_async_context(
            SignerClient(options["socket"] or signer_folder(settings) / DOOR_SOCKET)
        )
        store.open()
        stack.callback(store.close)
        pusher = await stack.enter_async_context(Pusher(signer, store, anywhere=options["push_anywhere"]))
        door = A2aDoor(signer, store, pusher, robot=robot)
        card: list[Card] = []
        app = application(door, lambda: card[0], key, chosen.token)
        front = await stack.enter_async_context(AsgiServer(app, host, port, tls=tls, option="--http"))
        url = options["url"].rstrip("/") or front.url
        card.append(Card(signer, key, url, robot=robot))
        announce(log, "a2a-started", f"a2a         {url}", url=url)
        await asyncio.Event().wait()
