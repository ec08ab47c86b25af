"""`aira mcp`: the door for programs that speak the Model Context Protocol."""

from __future__ import annotations

import asyncio
import logging
import sys
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


@click.group("mcp", invoke_without_command=True, short_help="let assistants hire robots, within your policy (MCP)")
@click.option("--socket", type=click.Path(path_type=Path), help="door.sock of the signer [in its state folder]")
@click.option("--http", metavar="HOST:PORT", help="serve streamable HTTP there instead of stdin and stdout")
@click.option("--name", "names", multiple=True, metavar="HOST", help="another name of this server (may be repeated)")
@click.option("--certificate", type=FILE, help="certificate of this server for HTTPS (PEM)")
@click.option("--key", type=FILE, help="key of the certificate (PEM)")
@click.option(
    "--token-file",
    type=FILE,
    help="private file with the token of clients over HTTP, made if missing [data_dir/mcp-token]",
)
@click.option("--issuer", default="", metavar="URL", help="OAuth server whose tokens are taken instead")
@click.option("--url", default="", metavar="URL", help="with --issuer: this server's URL as clients know it")
@with_settings(StorageSettings, "log_level", "log_format")
@click.pass_context
def command(context: click.Context, /, settings: Settings, **options: Any) -> None:
    """Serve a door to the market for assistants with a language model, and other clients of MCP.

    The door has no key: orders are signed by `aira signer`, within its policy. By default it speaks on stdin and
    stdout, for a client that starts this command itself; with --http on an address, to holders of the token.
    """
    if context.invoked_subcommand is None:
        run_until_stopped(lambda: _serve(settings, options), settings=settings, role="mcp")


async def _serve(settings: Settings, options: dict[str, Any]) -> None:
    with needs_extra("mcp", "aira mcp"):
        from bridges.mcp._door import McpDoor
        from mesh.signer.client import SignerClient
    from mesh.signer.protocol import DOOR_SOCKET

    socket = options["socket"] or settings.state_directory / "signer" / DOOR_SOCKET
    async with SignerClient(socket) as signer:
        server = McpDoor(signer).server
        if options["http"] is None:
            from bridges.mcp._stdio import serve_stdio

            if sys.stdin.isatty():
                click.echo("aira mcp speaks MCP on stdin and stdout; --http serves an address instead", err=True)
            await serve_stdio(server)
            return
        from bridges.mcp._http import PATH, application
        from bridges.web.access import server_tls
        from mesh.base.asgi_server import AsgiServer

        chosen = await asyncio.to_thread(_http_options, settings, options)
        chosen.check()
        tls = server_tls(chosen.certificate, chosen.key) if chosen.certificate else None
        app = application(server, chosen)
        async with AsyncExitStack() as stack:
            front = await stack.enter_async_context(AsgiServer(app, chosen.host, chosen.port, tls=tls, option="--http"))
            host = f"[{chosen.host}]" if ":" in chosen.host else chosen.host
            url = f"{'https' if tls else 'http'}://{host}:{front.port}{PATH}"
            announce(log, "mcp-started", f"mcp         {url}", url=url)
            await asyncio.Event().wait()


def _http_options(settings: Settings, options: dict[str, Any]) -> Any:
    """The `HttpOptions`. Raises `InputError`, `ConfigurationError`."""
    from bridges.mcp._http import HttpOptions, private_token
    from mesh.telemetry.metrics import listen_address

    host, port = listen_address(options["http"])
    path = options["token_file"] or settings.state_directory / "mcp-token"
    return HttpOptions(
        host=host,
        port=port,
        names=options["names"],
        certificate=str(options["certificate"] or ""),
        key=str(options["key"] or ""),
        issuer=options["issuer"],
        url=options["url"],
        token="" if options["issuer"] else private_token(path),
    )
