"""The doors over TLS, as processes, by the SDKs' own clients, with a certificate of a site's own authority."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING, Any

import aiohttp
import httpx
import httpx2
import jwt
import pytest
from a2a.types import TaskState
from a2a.utils.signing import create_signature_verifier
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from bridges.a2a._card import KEYS_PATH
from tests.mesh.signer.conftest import driver, folder, person
from tests.support.a2a.clients import process, request, sent
from tests.support.doors import TOKEN, door_process
from tests.support.mcp.clients import http_client
from tests.support.mcp.world import content, ended
from tests.support.signer.signers import GOOD
from tests.support.sites import Site

if TYPE_CHECKING:
    from pathlib import Path

    from a2a.types import AgentCard

    from tests.support.signer.signers import Driver, Person

__all__ = ["driver", "folder", "person"]
TOPIC, VALUE = GOOD


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def certified(site: Site) -> tuple[str, ...]:
    """The options of a door with the certificate of the site's router, which is for this machine."""
    return ("--certificate", str(site.router.certificate), "--key", str(site.router.key))


def trusting(site: Site) -> ssl.SSLContext:
    """How a client checks who serves."""
    context = ssl.create_default_context(cafile=str(site.authority.certificate))
    context.verify_flags |= ssl.VERIFY_X509_STRICT  # as Python does from 3.13 on
    return context


def order(driver: Driver) -> dict[str, Any]:
    return {"model": driver.model, "messages": [{"topic": TOPIC, "value": VALUE}], "cost": "1 XRT"}


async def test_an_agent_orders_over_tls_and_the_card_says_https(person: Person, driver: Driver, site: Site) -> None:
    person.allow(driver.model)
    tls = trusting(site)
    async with person.at_work() as (_, _, signer), process(signer.door, person.folder / "a", *certified(site)) as door:
        assert door.url.startswith("https://127.0.0.1:")
        async with door.client(verify=tls) as client:
            card: AgentCard = client._card  # type: ignore[attr-defined]
            assert {one.url for one in card.supported_interfaces} == {f"{door.url}/", f"{door.url}/rest"}
            *_, last = await sent(client, request(order(driver)))
            assert last.status_update.status.state == TaskState.TASK_STATE_COMPLETED
        head = jwt.get_unverified_header(f"{card.signatures[0].protected}..")
        assert head["jku"] == f"{door.url}{KEYS_PATH}"
        async with aiohttp.ClientSession() as session, session.get(head["jku"], ssl=tls) as response:
            (published,) = (await response.json())["keys"]
        create_signature_verifier(lambda _kid, _jku: jwt.PyJWK(published), ["ES256"])(card)
        await refuse_what_is_not_trusted(door.url)
    assert await person.spent() == 10**9


@pytest.mark.parametrize("version", [LATEST_MODERN_VERSION, LATEST_HANDSHAKE_VERSION])
async def test_a_model_orders_over_tls(person: Person, driver: Driver, site: Site, version: str) -> None:
    person.allow(driver.model)
    async with (
        person.at_work() as (_, _, signer),
        door_process("mcp", signer.door, person.folder / "m", *certified(site)) as door,
    ):
        assert door.url.startswith("https://127.0.0.1:")
        async with http_client(door.url, TOKEN, version, verify=trusting(site)) as client:
            job = content(await client.call_tool("order", order(driver) | {"idempotency_key": "k"}))
            assert (await ended(client, job))["state"] == "done"
        await refuse_what_is_not_trusted(door.url)
    assert await person.spent() == 10**9


async def refuse_what_is_not_trusted(url: str) -> None:
    """Plain HTTP gets no answer, and a client that does not know the site's authority asks nothing."""
    headers = {"Authorization": f"Bearer {TOKEN}"}
    async with httpx.AsyncClient(headers=headers, timeout=20) as http:
        with pytest.raises((httpx.RemoteProtocolError, httpx.ReadError)):  # closed, with or without a reset
            await http.post(url.replace("https://", "http://"), json={})
    async with httpx2.AsyncClient(headers=headers, timeout=20) as http2:
        with pytest.raises(httpx2.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
            await http2.post(url, json={})
