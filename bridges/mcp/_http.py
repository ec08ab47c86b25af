"""The door over HTTP: its options, who may use it, and the application that is served."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import urlsplit

import aiohttp
import jwt
from mcp.server.auth.provider import AccessToken, TokenVerifier
from mcp.server.auth.settings import AuthSettings
from mcp.server.transport_security import TransportSecuritySettings

from bridges.serving import DoorOptions, guarded
from mesh.base.log_context import log_event
from mesh.errors import ConfigurationError
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from mcp.server.lowlevel import Server

    from mesh.base.asgi_server import AsgiApplication

log = logging.getLogger(__name__)

PATH: Final = "/mcp"
MOST_SESSIONS: Final = 64
"""Sessions of clients of the older revisions; those of the current one have none."""
ALGORITHMS: Final = ("ES256", "RS256")


class KeysPace(NamedTuple):
    """How often the keys of the authorization server are asked for."""

    kept: float = 600.0
    """Seconds until they are asked for again; at once for a key that is not known."""
    pause: float = 10.0
    """Seconds between two such requests: anybody can name a key that is not known."""


KEYS_PACE: Final = KeysPace()


@dataclass(frozen=True, kw_only=True)
class McpOptions(DoorOptions):
    """Where the door listens, and who may use it: the holders of `token`, or those to whom `issuer` gave one."""

    issuer: str = ""
    """The OAuth authorization server whose tokens for `url` are taken."""

    @property
    def has_login(self) -> bool:
        return bool(self.token or self.issuer)

    def check(self) -> None:
        """Raise `ConfigurationError` for a door that is not protected, or whose tokens name no server."""
        super().check()
        if self.issuer and not self.url:
            raise ConfigurationError(
                "with --issuer the tokens must name this server",
                hint="give its URL as clients know it, as in --url https://robots.example.org/mcp",
                code="mcp-url-missing",
            )


def application(server: Server[Any], options: McpOptions) -> AsgiApplication:
    auth, verifier = None, None
    if options.issuer:
        verifier = IssuedTokens(options.issuer, options.url)
        auth = AuthSettings.model_validate(
            {"issuer_url": options.issuer, "resource_server_url": options.url, "validate_token_resource": True}
        )
    app = server.streamable_http_app(
        streamable_http_path=PATH,
        max_sessions=MOST_SESSIONS,
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),  # `guarded` has it
        host=options.host,
        auth=auth,
        token_verifier=verifier,
    )
    return guarded(app, options)


class IssuedTokens(TokenVerifier):
    """Takes the tokens (JWT, RFC 9068) that an authorization server issued for this door, and no others.

    A token is for the door alone: it is passed on to nobody.
    """

    def __init__(self, issuer: str, url: str) -> None:
        self._issuer = issuer
        self._url = url
        self._keys: dict[str, Any] = {}
        self._asked = -KEYS_PACE.kept
        self._asking = asyncio.Lock()

    async def verify_token(self, token: str) -> AccessToken | None:
        """The access that a token gives; None for one that is forged, over, or for another server."""
        try:
            head = jwt.get_unverified_header(token)
            key = await self._key(str(head.get("kid", "")))
            claims = jwt.decode(
                token,
                key,
                algorithms=ALGORITHMS,
                issuer=self._issuer,
                audience=self._url,
                options={"require": ["exp", "iss", "aud"]},
            )
        except (jwt.PyJWTError, LookupError, TypeError, ValueError) as error:
            log.debug("a token is refused: %s", type(error).__name__)
            return None
        return AccessToken(
            token="",
            client_id=str(claims.get("client_id") or claims.get("azp") or claims.get("sub") or "client"),
            scopes=str(claims.get("scope", "")).split(),
            expires_at=int(claims["exp"]),
            resource=self._url,
            subject=str(claims["sub"]) if claims.get("sub") else None,
            claims={"iss": self._issuer},
        )

    async def _key(self, name: str) -> Any:
        """The key of that name. Raises `KeyError`."""
        loop = asyncio.get_running_loop()
        if name in self._keys and loop.time() - self._asked <= KEYS_PACE.kept:
            return self._keys[name]  # also while somebody waits for a key that is not known
        async with self._asking:
            now = loop.time()
            if now - self._asked > (KEYS_PACE.pause if name not in self._keys else KEYS_PACE.kept):
                self._asked = now
                try:
                    self._keys = await self._fetch()
                except (aiohttp.ClientError, OSError, InvalidData, LookupError, TypeError, ValueError) as error:
                    fields = log_event("oauth-keys-unavailable", code=type(error).__name__)
                    log.warning("the authorization server gives no keys: %s", type(error).__name__, extra=fields)
        return self._keys[name]

    async def _fetch(self) -> dict[str, Any]:
        timeout = aiohttp.ClientTimeout(total=10)
        async with aiohttp.ClientSession(timeout=timeout) as session:
            base = self._issuer.rstrip("/")
            about = await _document(session, f"{base}/.well-known/oauth-authorization-server")
            about = about or await _document(session, f"{base}/.well-known/openid-configuration")
            if about.get("issuer") != self._issuer:
                raise LookupError("another issuer")
            listed = (await _document(session, str(about["jwks_uri"])))["keys"]
        keys = {}
        for each in listed[:100]:
            if not (isinstance(each, dict) and each.get("kid") and each.get("use", "sig") == "sig"):
                continue
            if each.get("alg", "ES256") in ALGORITHMS:
                with suppress(jwt.PyJWTError):  # it may have keys of kinds that are not known here
                    keys[str(each["kid"])] = jwt.PyJWK(each, each.get("alg")).key
        return keys


async def _document(session: aiohttp.ClientSession, url: str) -> dict[str, Any]:
    """A JSON object; an empty one if there is none. Only over TLS, or from this machine."""
    parts = urlsplit(url)
    if parts.scheme != "https" and parts.hostname not in ("127.0.0.1", "localhost"):
        raise LookupError("not over TLS")
    async with session.get(url, allow_redirects=False) as response:
        if response.status != 200:
            return {}
        data = b""
        async for part in response.content.iter_any():
            data += part
            if len(data) > 1 << 18:
                raise LookupError("too long")
        found = decode_json(data)
        return found if isinstance(found, dict) else {}
