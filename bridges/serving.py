"""The servers of bridges: where they listen, how they prove who they are, and whom they let in.

Those for software agents (`aira mcp`, `aira a2a`) are doors to a signer.
"""

from __future__ import annotations

import hmac
import ipaddress
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar
from urllib.parse import urlsplit

import click

from mesh.cli.options import FILE
from mesh.errors import ConfigurationError
from mesh.signer.protocol import DOOR_SOCKET, LARGEST_REQUEST, signer_folder

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Callable, Collection

    from mesh.base.asgi_server import AsgiApplication, Message, Receive, Send
    from mesh.settings import Settings

F = TypeVar("F", bound="Callable[..., Any]")


@dataclass(frozen=True, kw_only=True)
class ServerOptions:
    """Where a server listens, and how it is protected."""

    protection: ClassVar[str] = "--certificate, --key and --token-file"
    """The options without which other machines are not served."""
    host: str = "127.0.0.1"
    port: int = 0
    token: str = field(default="", repr=False)
    """What its users log in with; empty: no login."""
    certificate: str = ""
    key: str = ""

    @property
    def has_login(self) -> bool:
        return bool(self.token)

    def check(self) -> None:
        """Raise `ConfigurationError` for a server that other machines can reach without TLS and login."""
        if not (self.certificate and self.key and self.has_login) and not is_loopback(self.host):
            raise ConfigurationError(
                f"other machines can reach {self.host}: that needs TLS and a login",
                hint=f"give {self.protection}, or listen on 127.0.0.1",
                code="web-not-protected",
            )

    def tls(self) -> ssl.SSLContext | None:
        """How the server proves who it is, by its two files (PEM); None without. Raises `ConfigurationError`."""
        import ssl  # loads OpenSSL

        if not (self.certificate or self.key):
            return None
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            context.load_cert_chain(Path(self.certificate).expanduser(), Path(self.key).expanduser())
        except OSError as error:  # errors of TLS are `OSError`, too
            why = "not a certificate and its key" if isinstance(error, ssl.SSLError) else error.strerror
            raise ConfigurationError(
                f"can't use the certificate {self.certificate or '(none)'} with the key {self.key or '(none)'}: {why}",
                hint="--certificate and --key are files in PEM of one pair",
                code="tls-unusable",
            ) from None
        return context


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def with_certificate(function: F) -> F:
    """Give a command the options of TLS."""
    function = click.option("--key", type=FILE, help="key of the certificate (PEM)")(function)
    return click.option("--certificate", type=FILE, help="certificate of this server for TLS (PEM)")(function)


def listening(address: str, options: dict[str, Any], token: str) -> dict[str, Any]:
    """The fields of `ServerOptions`, from an address (`HOST:PORT`) and options of the command line. Raises
    `InputError`."""
    from mesh.telemetry.metrics import listen_address

    host, port = listen_address(address)
    certificate, key = (str(options[name] or "") for name in ("certificate", "key"))
    return {"host": host, "port": port, "token": token, "certificate": certificate, "key": key}


@dataclass(frozen=True, kw_only=True)
class DoorOptions(ServerOptions):
    """The same of a door: programs always need a login."""

    protection: ClassVar[str] = "--certificate and --key"
    names: tuple[str, ...] = ()
    """Names besides its own address by which clients reach it."""
    url: str = ""
    """Its URL as clients know it; may be empty."""

    def check(self) -> None:
        """Raise `ConfigurationError` for one that other machines can reach without TLS, or without a login."""
        if not self.has_login:
            raise ConfigurationError("the door needs a token", hint="give --token-file", code="token-too-short")
        super().check()

    def knows_host(self, given: str) -> bool:
        """Whether a `Host` header names this server, with or without a port."""
        try:
            name = urlsplit(f"//{given}").hostname
        except ValueError:
            return False
        known = (self.host, *self.names, urlsplit(self.url).hostname or "", "127.0.0.1", "localhost", "::1")
        return bool(name) and name in {one.strip("[]").lower() for one in known}


def door_socket(settings: Settings, options: dict[str, Any]) -> Path:
    return Path(options["socket"] or signer_folder(settings) / DOOR_SOCKET)


def with_door(role: str) -> Callable[[F], F]:
    """Give a command the options of a door, whose private file with the token is named after the `role`."""
    token = f"private file with the token of clients, made if missing [data_dir/{role}-token]"
    name = "another name of this server (may be repeated)"
    socket = "door.sock of the signer [in its state folder]"

    def decorated(function: F) -> F:
        for option in (
            click.option("--url", default="", metavar="URL", help="this server's URL as clients know it"),
            click.option("--token-file", type=FILE, help=token),
            with_certificate,
            click.option("--name", "names", multiple=True, metavar="HOST", help=name),
            click.option("--socket", type=click.Path(path_type=Path), help=socket),
        ):
            function = option(function)
        return function

    return decorated


def door_fields(role: str, settings: Settings, options: dict[str, Any], *, has_token: bool = True) -> dict[str, Any]:
    """The fields of `DoorOptions` that `with_door` gave; the token's file is made if it is missing.

    Raises `InputError`, `ConfigurationError`.
    """
    from mesh.base.private_files import private_token

    token = private_token(options["token_file"] or settings.state_directory / f"{role}-token") if has_token else ""
    return listening(options["http"], options, token) | {"names": options["names"], "url": options["url"]}


@asynccontextmanager
async def served_door(app: AsgiApplication, options: DoorOptions) -> AsyncIterator[str]:
    """Serve a door; gives the URL of its address. Raises `ConfigurationError`, `PortUnavailable`."""
    from mesh.base.asgi_server import AsgiServer

    options.check()
    async with AsgiServer(app, options.host, options.port, tls=options.tls(), option="--http") as server:
        yield server.url


def guarded(app: AsgiApplication, options: DoorOptions, *, public: Collection[str] = ()) -> AsgiApplication:
    """An application for those who know the token, compared in constant time; without one in the options the
    application itself looks who asks. Anybody may read the paths in `public`.

    A request has at most `LARGEST_REQUEST` bytes. It names this server, and no page of another site sends it: a browser
    that was made to take another name for this machine's address reaches nothing.
    """
    from starlette.datastructures import Headers
    from starlette.responses import JSONResponse

    token = f"Bearer {options.token}".encode() if options.token else b""

    async def serve(scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (scope["path"] in public and scope["method"] in ("GET", "HEAD")):
            await app(scope, receive, send)
            return
        headers, arrived = Headers(scope=scope), 0
        site, _, origin = headers.get("origin", "http://localhost").partition("://")
        kind, _, given = headers.get("authorization", "").partition(" ")
        length = headers.get("content-length", "0")
        more = {}
        if not options.knows_host(headers.get("host", "")):
            status, text = 421, "this server has another name; its operator gives it with --name"
        elif site not in ("http", "https") or not options.knows_host(origin):
            status, text = 403, "pages of other sites may not use this server"
        elif token and not hmac.compare_digest(f"{kind.title()} {given.strip()}".encode("latin-1"), token):
            status, text, more = 401, "a token is needed: Authorization: Bearer …", {"WWW-Authenticate": "Bearer"}
        elif not length.isdigit() or len(length) > 12 or int(length) > LARGEST_REQUEST:
            status, text, more = 413, f"a request has at most {LARGEST_REQUEST} bytes", {"Connection": "close"}
        else:

            async def bounded() -> Message:
                nonlocal arrived
                message = await receive()
                arrived += len(message.get("body", b""))
                return {"type": "http.disconnect"} if arrived > LARGEST_REQUEST else message

            await app(scope, bounded, send)
            return
        await JSONResponse({"error": {"code": status, "message": text}}, status, more)(scope, receive, send)

    return serve
