"""Servers with `connect_timeout = -1` start in any order: each logs once what it waits for, and goes on by itself."""

from __future__ import annotations

import asyncio
import shutil
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Account, write_keyfile
from mesh.dev.development import deploy_market
from mesh.ops.identity import Member
from tests.support.cli.site import events, has_event
from tests.support.commands import AIRA, Serving
from tests.support.nodes import Anvil
from tests.support.routers import EmbeddedRouter
from tests.support.sites import Site as ClosedSite
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

PROVIDER = (*AIRA, "provider")
AGENT = (sys.executable, "-c", "from mesh import Agent; Agent().run()")
FILES = '"event": "files-outage"'
SECONDS = 60.0


@contextmanager
def started(*command: str, says: str = FILES, variables: Mapping[str, str]) -> Iterator[Serving]:
    """A server that waits for what it needs without limit, and logs that in JSON."""
    waiting = {"AIRA_CONNECT_TIMEOUT": "-1", "AIRA_LOG_FORMAT": "json"}
    with Serving(*command, says=says, variables={**waiting, **variables}) as server:
        yield server


async def until_event(server: Serving, name: str, **facts: str) -> None:
    """Wait until the server has logged such an event; it must still run."""
    await until(lambda: has_event(server, name, **facts), what=f"{name} {facts} in the log", seconds=SECONDS)
    assert server.pid


def variables_of(folder: Path, *, node: int, router: int) -> dict[str, str]:
    return {
        "AIRA_DATA_DIR": str(folder / "data"),
        "AIRA_KEYFILE": str(folder / "account.json"),
        "AIRA_KEYFILE_PASSWORD_FILE": str(folder / "password"),
        "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{node}",
        "AIRA_CONNECT": f"tcp/127.0.0.1:{router}",
    }


def hand_over(folder: Path, key: bytes) -> None:
    """The files of an account."""
    (folder / "password").write_text("secret\n")
    write_keyfile(folder / "account.json", key, "secret", iterations=1)


@pytest.mark.sample("program", "role")
@pytest.mark.parametrize(
    ("program", "role"),
    [(PROVIDER, "provider"), (AGENT, "agent")],
    ids=["provider", "agent"],
)
async def test_a_server_waits_for_its_files_then_the_node_the_contracts_and_the_router(
    program: tuple[str, ...], role: str, tmp_path: Path
) -> None:
    node, router = Anvil(), EmbeddedRouter()
    variables = variables_of(tmp_path, node=node.port, router=router.port)
    with started(*program, variables=variables) as server, node, router:
        node.stop()
        router.stop()
        await asyncio.to_thread(hand_over, tmp_path, key=node.private_keys[0])
        await until_event(server, "files-recovered")
        await until_event(server, "startup-outage", code="node-unreachable")
        await asyncio.to_thread(node.start)
        await until_event(server, "startup-outage", code="no-contracts")
        await deploy_market(node.url, node.private_keys)
        await until_event(server, "router-outage", code="network-unavailable")
        await asyncio.to_thread(router.start)
        await until_event(server, f"{role}-started")
        unreachable = [event for event in events(server.log()) if event.get("code") == "node-unreachable"]
        assert len(unreachable) == 1


async def test_a_provider_waits_for_its_stake(tmp_path: Path) -> None:
    with Anvil() as node, EmbeddedRouter() as router:
        market = await deploy_market(node.url, node.private_keys)
        late = Account(node.private_keys[3])
        await asyncio.to_thread(hand_over, tmp_path, key=node.private_keys[3])
        variables = variables_of(tmp_path, node=node.port, router=router.port)
        with started(*PROVIDER, says='"code": "no-stake"', variables=variables) as server:
            async with market.chain(node.url, "provider") as chain:
                await chain.tokens.transfer(late.address, 10**9)
            market.accounts["late"] = late
            async with market.chain(node.url, "late") as chain:
                await chain.lighthouses.become_provider(market.deployment.lighthouse, 10**9)
            await until_event(server, "provider-started")


async def test_an_edge_agent_waits_for_its_identity_and_its_router(tmp_path: Path) -> None:
    site = ClosedSite(tmp_path)
    folder = site.enlist(Member(name="board", address="0x" + "ed" * 20, roles=("edge",), agent="0x" + "ab" * 20))
    away = folder.certificate.with_suffix(".away")
    folder.certificate.rename(away)
    variables = {
        "AIRA_CONNECT": site.endpoint,
        "AIRA_TLS_CA": str(folder.ca),
        "AIRA_TLS_CERTIFICATE": str(folder.certificate),
        "AIRA_TLS_KEY": str(folder.key),
    }
    edge = (*AIRA, "edge", "/dev/nowhere", "--agent", "0x" + "ab" * 20)
    with started(*edge, says=str(folder.certificate), variables=variables) as server:
        away.rename(folder.certificate)
        await until_event(server, "router-outage", code="network-unavailable")
        with site.open_router("wheel"):
            await until_event(server, "edge-started")


async def test_a_router_waits_for_its_roster(tmp_path: Path) -> None:
    site = ClosedSite(tmp_path)
    away = tmp_path / "away.toml"
    shutil.move(site.roster, away)
    variables = {
        "AIRA_LISTEN": site.endpoint,
        "AIRA_ROSTER": str(site.roster),
        "AIRA_TLS_CA": str(site.router.ca),
        "AIRA_TLS_CERTIFICATE": str(site.router.certificate),
        "AIRA_TLS_KEY": str(site.router.key),
    }
    with started(*AIRA, "router", says=str(site.roster), variables=variables) as server:
        shutil.move(away, site.roster)
        await until_event(server, "router-started")


async def test_an_agent_that_the_router_rejects_waits_until_it_is_accepted(tmp_path: Path) -> None:
    """The router does not accept the certificate yet, as its site is being set up again."""
    (tmp_path / "other").mkdir()
    site, other = ClosedSite(tmp_path), ClosedSite(tmp_path / "other")
    with Anvil() as node:
        await deploy_market(node.url, node.private_keys)
        account = Account(node.private_keys[1])
        await asyncio.to_thread(hand_over, tmp_path, key=node.private_keys[1])
        mine = site.enlist(Member(name="robot", address=account.address, roles=("agent",)))
        member = other.certify("robot", account.address, "agent")
        variables = variables_of(tmp_path, node=node.port, router=site.port) | {
            "AIRA_CONNECT": site.endpoint,
            "AIRA_TLS_CA": str(member.ca),
            "AIRA_TLS_CERTIFICATE": str(member.certificate),
            "AIRA_TLS_KEY": str(member.key),
        }
        with (
            site.open_router("wheel"),
            started(*AGENT, says='"event": "startup-outage"', variables=variables) as server,
        ):
            shutil.copytree(mine.path, member.path, dirs_exist_ok=True)
            await until_event(server, "agent-started")
