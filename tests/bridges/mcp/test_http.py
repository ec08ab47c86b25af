"""The door over HTTP: Host and Origin, tokens of a file and of an authorization server, sizes, slow clients."""

from __future__ import annotations

import asyncio
import json
import stat
import time
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import aiohttp
import jwt
import pytest
from aiohttp import web
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from bridges.mcp._http import KEYS_PACE, PATH, IssuedTokens, McpOptions, _document
from mesh.base.door import DoorLimits
from mesh.base.http_server import HttpServer
from mesh.base.private_files import private_token
from mesh.errors import ConfigurationError, PortUnavailable
from tests.support.doors import TOKEN
from tests.support.mcp.clients import CALL, HEADERS, http_client, served
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


@asynccontextmanager
async def posting(url: str, **headers: str) -> AsyncIterator[aiohttp.ClientResponse]:
    async with (
        aiohttp.ClientSession() as session,
        session.post(url, json=CALL, headers=HEADERS | headers) as response,
    ):
        yield response


@pytest.mark.parametrize("version", [LATEST_MODERN_VERSION, LATEST_HANDSHAKE_VERSION])
async def test_both_revisions_of_the_protocol_are_served(version: str) -> None:
    async with served(McpOptions(token=TOKEN)) as url, http_client(url, TOKEN, version) as client:
        assert client.protocol_version == version
        assert {tool.name for tool in (await client.list_tools()).tools} >= {"find_robots", "order", "verify"}
        result = await client.call_tool("balance", {})
        assert result.is_error
        assert result.structured_content is not None
        assert result.structured_content["code"] == "signer-unavailable"
        assert result.structured_content["next"]
        assert "/nowhere" not in json.dumps(result.structured_content)


@pytest.mark.parametrize(
    "headers",
    [{}, {"Authorization": "Bearer another token"}, {"Authorization": TOKEN}, {"Authorization": "Bearer "}],
    ids=["none", "wrong", "no-bearer", "empty"],
)
async def test_without_the_token_nothing_is_served(headers: dict[str, str]) -> None:
    async with served(McpOptions(token=TOKEN)) as url, posting(url, **headers) as response:
        assert response.status == 401
        assert "Bearer" in response.headers["WWW-Authenticate"]


async def test_a_token_in_the_url_is_none() -> None:
    async with served(McpOptions(token=TOKEN)) as url, posting(f"{url}?access_token={TOKEN}") as response:
        assert response.status == 401


async def test_a_client_that_sends_nothing_is_ended() -> None:
    limits = DoorLimits(head=0.2)
    async with served(McpOptions(token=TOKEN), limits=limits) as url:
        host, port = url.removeprefix("http://").removesuffix(PATH).split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        async with asyncio.timeout(10):
            with suppress(ConnectionError):
                assert await reader.read() == b""
        writer.close()


async def test_connections_of_one_address_are_limited() -> None:
    limits = DoorLimits(per_address=4)
    async with served(McpOptions(token=TOKEN), limits=limits) as url:
        host, port = url.removeprefix("http://").removesuffix(PATH).split(":")
        silent = [await asyncio.open_connection(host, int(port)) for _ in range(8)]
        async with posting(url, Authorization=f"Bearer {TOKEN}") as response:
            assert response.status == 200
        for _, writer in silent:
            writer.close()


async def test_a_port_that_is_taken_is_an_error() -> None:
    async with served(McpOptions(token=TOKEN)) as url:
        port = int(url.removesuffix(PATH).rpartition(":")[2])
        with pytest.raises(PortUnavailable) as caught:
            async with served(McpOptions(token=TOKEN, port=port)):
                pass
        assert caught.value.port == port


def test_other_machines_need_tls() -> None:
    with pytest.raises(ConfigurationError) as caught:
        McpOptions(host="0.0.0.0", token=TOKEN).check()
    assert "--certificate" in caught.value.hint


def test_the_token_is_made_once_and_private(tmp_path: Path) -> None:
    path = tmp_path / "state" / "mcp-token"
    token = private_token(path)
    assert len(token) > 30
    assert private_token(path) == token
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("spoil", ["open", "short", "link", "folder"])
def test_a_token_file_that_is_not_private_is_refused(tmp_path: Path, spoil: str) -> None:
    path = tmp_path / "token"
    if spoil == "folder":
        path.mkdir()
    else:
        path.write_text("short" if spoil == "short" else TOKEN)
        path.chmod(0o644 if spoil == "open" else 0o600)
    if spoil == "link":
        (tmp_path / "link").symlink_to(path)
        path = tmp_path / "link"
    with pytest.raises(ConfigurationError) as caught:
        private_token(path)
    assert caught.value.code in ("token-file-unusable", "token-too-short")
    assert TOKEN not in str(caught.value)


class AuthorizationServer:
    """An OAuth authorization server that gives its keys, and issues tokens."""

    def __init__(self) -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.issuer = ""
        self.asked = 0
        self.pause = 0.05
        """Seconds between two parts of an answer."""

    async def about(self, request: web.Request) -> web.Response:
        return web.json_response({"issuer": self.issuer, "jwks_uri": f"{self.issuer}/keys"})

    async def keys(self, request: web.Request) -> web.StreamResponse:
        self.asked += 1
        public = json.loads(jwt.algorithms.ECAlgorithm.to_jwk(self.key.public_key()))
        other = json.loads(jwt.algorithms.RSAAlgorithm.to_jwk(RSA.public_key()))
        unknown = {"kty": "EC", "crv": "P-0", "x": "AA", "y": "AA", "kid": "unknown", "alg": "ES256"}
        known = [public | {"kid": "one", "alg": "ES256", "use": "sig"}, other | {"kid": "rsa", "alg": "RS256"}]
        whole = json.dumps({"keys": [unknown, "no key", *known]}).encode()
        answer = web.StreamResponse()
        await answer.prepare(request)
        for part in (whole[:40], whole[40:]):
            await answer.write(part)
            await asyncio.sleep(self.pause)
        return answer

    def token(self, *, key: Any = None, algorithm: str = "ES256", kid: str = "one", **claims: Any) -> str:
        body = {"iss": self.issuer, "aud": AUDIENCE, "exp": time.time() + 60, "sub": "ann", "scope": "work"} | claims
        return jwt.encode(body, self.key if key is None else key, algorithm=algorithm, headers={"kid": kid})


AUDIENCE = "https://robots.example/mcp"
RSA = rsa.generate_private_key(65537, 2048)


@asynccontextmanager
async def authorization_server() -> AsyncIterator[AuthorizationServer]:
    issuing, app = AuthorizationServer(), web.Application()
    app.router.add_get("/.well-known/oauth-authorization-server", issuing.about)
    app.router.add_get("/keys", issuing.keys)
    async with HttpServer(app, "127.0.0.1", 0) as server:
        issuing.issuer = f"http://127.0.0.1:{server.port}"
        yield issuing


async def test_tokens_of_the_authorization_server_are_taken() -> None:
    async with authorization_server() as issuing, served(McpOptions(issuer=issuing.issuer, url=AUDIENCE)) as url:
        for _ in range(3):
            async with posting(url, Authorization=f"Bearer {issuing.token()}") as response:
                assert response.status == 200
        assert issuing.asked == 1
        about = url.removesuffix(PATH) + "/.well-known/oauth-protected-resource/mcp"
        async with aiohttp.ClientSession() as session, session.get(about) as response:
            named = await response.json()
        assert named["resource"] == AUDIENCE
        assert named["authorization_servers"] == [issuing.issuer]


async def test_other_tokens_are_not_taken() -> None:
    async with authorization_server() as issuing, served(McpOptions(issuer=issuing.issuer, url=AUDIENCE)) as url:
        other = ec.generate_private_key(ec.SECP256R1())
        form, kind = serialization.Encoding.X962, serialization.PublicFormat.UncompressedPoint
        public = issuing.key.public_key().public_bytes(form, kind)
        forged = {
            "for another server": issuing.token(aud="https://other.example/mcp"),
            "for no server": issuing.token(aud=None),
            "of another issuer": issuing.token(iss="https://other.example"),
            "over": issuing.token(exp=time.time() - 5),
            "by another key": issuing.token(key=other),
            "by a key that is not known": issuing.token(kid="two"),
            "by the public key as a secret": issuing.token(key=public, algorithm="HS256"),
            "by the name of a key of another kind": issuing.token(kid="rsa"),
            "unsigned": issuing.token(key="", algorithm="none"),
            "no token": "x.y.z",
        }
        for why, token in forged.items():
            async with posting(url, Authorization=f"Bearer {token}") as response:
                assert response.status == 401, why
        assert issuing.asked == 1, "keys that are not known are not asked for again and again"


async def test_who_has_a_token_does_not_wait_for_those_who_name_keys_that_are_not_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("bridges.mcp._http.KEYS_PACE", KEYS_PACE._replace(pause=0.0))
    async with authorization_server() as issuing:
        tokens = IssuedTokens(issuing.issuer, AUDIENCE)
        assert await tokens.verify_token(issuing.token()) is not None
        issuing.pause = 60.0
        stranger = asyncio.create_task(tokens.verify_token(issuing.token(kid="two")))
        await until(lambda: issuing.asked == 2)
        assert await tokens.verify_token(issuing.token()) is not None
        assert not stranger.done()
        stranger.cancel()
        issuing.pause = 0.0


@pytest.mark.parametrize("url", ["http://localhost.example/keys", "http://127.0.0.1.example/", "http://[::1/", "keys"])
async def test_keys_come_over_tls_only(url: str) -> None:
    async with aiohttp.ClientSession() as session:
        with pytest.raises((LookupError, ValueError)):
            await _document(session, url)
