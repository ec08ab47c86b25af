"""A page that other machines reach: TLS, logins by token and by certificates of the site, and what operators may do."""

from __future__ import annotations

import asyncio
import ssl
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import ClientConnectionError, ClientSession, CookieJar, TCPConnector, WSServerHandshakeError

from bridges.web._access import WebOptions
from bridges.web.components import opened
from bridges.web.server import PageServer
from mesh.base.fresh_file import CHECK_INTERVAL
from mesh.errors import ConfigurationError
from mesh.network import Network
from mesh.ops.identity import Member
from mesh.testing._market import working_provider
from tests.bridges.web.conftest import Browser
from tests.support.market import MODEL, Place, offering
from tests.support.objectives import objective
from tests.support.sites import MARKET, Site
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.ops.identity.certificates import MemberFolder
    from mesh.testing import MarketChain

TOKEN, OPERATOR = "a token of people 123", "a token of operators 456"
BOSS, ANN, GONE, STRANGER, PAGE = ("0x" + f"{number:02x}" * 20 for number in range(1, 6))


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path / "members")


def tls(folder: MemberFolder) -> dict[str, str]:
    """The settings of a member."""
    return {"tls_ca": str(folder.ca), "tls_certificate": str(folder.certificate), "tls_key": str(folder.key)}


def of_the_page(site: Site) -> dict[str, Any]:
    """The options of a server that listens for other machines, with a certificate of the site."""
    name = f"page {len(list(site.folder.iterdir()))}"
    folder = site.certify(name, PAGE, "person", hosts=("127.0.0.1",))
    options = {"certificate": str(folder.certificate), "key": str(folder.key), "ca": str(folder.ca)}
    return {"host": "0.0.0.0", "names": ("127.0.0.1",), **options}


@asynccontextmanager
async def visitor(site: Site, server: PageServer, folder: MemberFolder | None = None) -> AsyncIterator[Browser]:
    """Somebody on another machine, who shows the certificate in `folder`."""
    context = ssl.create_default_context(cafile=str(site.authority.certificate))
    context.verify_flags |= ssl.VERIFY_X509_STRICT  # as Python does from 3.13 on
    if folder is not None:
        context.load_cert_chain(folder.certificate, folder.key)
    jar = CookieJar(unsafe=True)  # takes cookies of IP addresses
    async with ClientSession(connector=TCPConnector(ssl=context), cookie_jar=jar) as session:
        browser = Browser(session, server)
        server.url = server.url.replace("0.0.0.0", "127.0.0.1")
        yield browser


async def test_other_machines_log_in_by_tls(serve: Any, site: Site) -> None:
    async with serve(**of_the_page(site), token=TOKEN, operator_token=OPERATOR) as page:
        async with visitor(site, page.server) as browser:
            stream = f"{page.server.url}/api/v1/stream"
            assert page.server.url.startswith("https://")
            assert (await browser.get("market", status=401))["error"]["code"] == "login-required"
            assert (await browser.post("session", {"token": "no"}, status=401))["error"]["code"] == "login-required"
            with pytest.raises(WSServerHandshakeError):
                await browser.session.ws_connect(stream)
            assert (await browser.post("session", {"token": TOKEN})) == {"role": "anybody"}
            (cookie,) = list(browser.session.cookie_jar)
            assert (cookie["secure"], cookie["httponly"], cookie["samesite"]) == (True, True, "Strict")
            assert (await browser.get("market"))["role"] == "anybody"
            async with browser.session.ws_connect(stream) as socket:
                await socket.send_json({"subscribe": ["market"]})
                assert (await socket.receive_json())[0]["kind"] == "hello"
            assert (await browser.post("session", {"token": OPERATOR})) == {"role": "operator"}
            assert (await browser.get("market"))["role"] == "operator"
        async with ClientSession() as plain:
            with pytest.raises(ClientConnectionError):
                await plain.get(page.server.url.replace("https", "http"))


async def test_members_log_in_by_their_certificates(serve: Any, site: Site, tmp_path: Path) -> None:
    boss = site.enlist(Member(name="boss", address=BOSS, roles=("operator",)))
    ann = site.enlist(Member(name="ann", address=ANN, roles=("person",)))
    gone = site.enlist(Member(name="gone", address=GONE, roles=("operator",), revoked=True))
    stranger = site.certify("stranger", STRANGER, "operator")  # says so itself; the roster does not
    other = Site(tmp_path / "another site").certify("boss", BOSS, "operator")
    async with serve(**of_the_page(site), roster=str(site.roster)) as page:
        for folder, role in ((boss, "operator"), (ann, "anybody")):
            async with visitor(site, page.server, folder) as browser:
                assert (await browser.get("market"))["role"] == role
        for folder in (gone, stranger):
            async with visitor(site, page.server, folder) as browser:
                assert (await browser.get("market", status=401))["error"]["code"] == "login-required"
        for none in (other, None):
            async with visitor(site, page.server, none) as browser:
                with pytest.raises(ClientConnectionError):
                    await browser.get("market")
        for change in (lambda: site.roster.write_text("garbage"), site.roster.unlink):
            change()  # the last roster that could be read stays in force
            await asyncio.sleep(1.1 * CHECK_INTERVAL)
            async with visitor(site, page.server, boss) as browser:
                assert (await browser.get("market"))["role"] == "operator"
        site.roster.write_text(f'lighthouses = ["{MARKET}"]\n')
        await asyncio.sleep(1.1 * CHECK_INTERVAL)
        async with visitor(site, page.server, boss) as browser:
            await browser.get("market", status=401)
    async with (
        serve(**of_the_page(site), roster=str(site.roster), token=TOKEN) as page,
        visitor(site, page.server) as browser,
    ):  # with a token besides, a certificate is not asked of everybody
        await browser.get("market", status=401)
        await browser.post("session", {"token": TOKEN})
        assert (await browser.get("market"))["role"] == "anybody"


def test_a_roster_without_tls_is_refused() -> None:
    with pytest.raises(ConfigurationError):
        WebOptions(roster="roster.toml").check()
    with pytest.raises(ConfigurationError):
        WebOptions(host="0.0.0.0", roster="roster.toml", certificate="c", key="k").check()
    WebOptions(host="0.0.0.0", roster="roster.toml", certificate="c", key="k", ca="ca").check()


async def test_an_operator_of_the_roster_starts_and_finishes_a_job_of_a_robot(
    market_chain: MarketChain, site: Site, tmp_path: Path
) -> None:
    boss = site.enlist(Member(name="boss", address=BOSS, roles=("operator",)))
    ann = site.enlist(Member(name="ann", address=ANN, roles=("person",)))
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        place = await enter(Place(market_chain, site.endpoint, tmp_path))
        roles: dict[str, Any] = {"robot": "agent", "person": "person", "provider": "provider"}
        folders = {
            name: site.enlist(Member(name=name, address=place.address(name), roles=(role,)))
            for name, role in roles.items()
        }
        operating = site.enlist(Member(name="page", address=PAGE, roles=("person", "operator")))
        watching = site.enlist(Member(name="other page", address=STRANGER, roles=("person",)))
        stack.enter_context(site.open_router("wheel"))
        await enter(offering(place.agent("robot", **tls(folders["robot"]))))
        person = await enter(place.agent("person", **tls(folders["person"])))
        network = await enter(Network(site.client(folders["provider"])))
        await enter(working_provider(network.session, place.chains["provider"], MARKET))
        contract = await person.demand(place.save(objective(("/go", "there"))), cost=3)
        job, robot = {"liability": contract.address, "success": True}, place.address("robot")

        @asynccontextmanager
        async def page(folder: MemberFolder, name: str) -> AsyncIterator[PageServer]:
            options = WebOptions(**of_the_page(site), port=0, roster=str(site.roster), static=tmp_path)
            settings = place.settings(name, **tls(folder))
            async with opened(settings, chain=place.chains["provider"]) as parts, PageServer(parts, options) as server:
                yield server

        async with page(operating, "page") as server:
            async with visitor(site, server, ann) as browser:
                refused = await browser.post(f"agents/{robot}/start", job, status=403)
                assert refused["error"]["code"] == "operators-only"
            async with page(watching, "other") as other, visitor(site, other, boss) as browser:
                # Its own certificate gives this server no right to services: the router carries no request.
                refused = await browser.post(f"agents/{robot}/start", job, status=502)
                assert refused["error"]["reason"] == "no-agent"
            async with visitor(site, server, boss) as browser:

                async def started() -> bool:
                    return bool((await browser.post(f"agents/{robot}/start", job))["success"])

                await until_found(started, what="the job to be ready")
                await browser.post(f"agents/{robot}/finish", job)
                outcome = await contract.outcome()
                assert outcome.success
                assert (await browser.get(f"liabilities/{contract.address}"))["liability"]["model"] == MODEL
