"""Servers that are told to wait for ever begin in any order: each says once what it waits for, and goes on alone."""

from __future__ import annotations

import asyncio
import shutil
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Account, write_keyfile
from mesh.devchain.development import deploy_market
from mesh.identity import Member
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
FILES = "waiting: files that are not there yet: "
SECONDS = 60.0


@contextmanager
def started(*command: str, says: str, variables: Mapping[str, str]) -> Iterator[Serving]:
    """A server that waits for ever for what it needs, and says so."""
    with Serving(*command, says=says, variables={"AIRA_CONNECT_TIMEOUT": "-1", **variables}) as server:
        yield server


async def says(server: Serving, words: str) -> None:
    """Wait until the server has said so; it must not have ended."""
    await until(lambda: words in server.log(), what=f"{words!r} in the log", seconds=SECONDS)
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
    write_keyfile(folder / "account.json", key, "secret")


@pytest.mark.parametrize(
    ("program", "role", "serves"),
    [(PROVIDER, "provider", " serves airalab.lighthouse"), (AGENT, "agent", " on airalab.lighthouse")],
    ids=["provider", "agent"],
)
async def test_a_server_waits_for_its_files_then_the_node_the_contracts_and_the_router(
    program: tuple[str, ...], role: str, serves: str, tmp_path: Path
) -> None:
    node, router = Anvil(), EmbeddedRouter()
    variables = variables_of(tmp_path, node=node.port, router=router.port)
    with started(*program, says=FILES, variables=variables) as server, node, router:
        node.stop()
        router.stop()
        await asyncio.to_thread(hand_over, tmp_path, key=node.private_keys[0])
        await says(server, "the files are there")
        await says(server, f"the {role} waits: no Ethereum node answers at")
        await asyncio.to_thread(node.start)
        await says(server, f"the {role} waits: the chain 31337 has no ")
        await deploy_market(node.url, node.private_keys)
        await says(server, "waiting for a router: no Zenoh router at")
        await asyncio.to_thread(router.start)
        await says(server, serves)
        assert server.log().count(f"the {role} waits: no Ethereum node") == 1


async def test_a_provider_waits_for_its_stake(tmp_path: Path) -> None:
    with Anvil() as node, EmbeddedRouter() as router:
        market = await deploy_market(node.url, node.private_keys)
        late = Account.from_key(node.private_keys[3])
        await asyncio.to_thread(hand_over, tmp_path, key=node.private_keys[3])
        variables = variables_of(tmp_path, node=node.port, router=router.port)
        with started(*PROVIDER, says=f"the provider waits: {late.address} has no stake", variables=variables) as server:
            async with market.chain(node.url, "provider") as chain:
                await chain.tokens.transfer(late.address, 10**9)
            market.accounts["late"] = late
            async with market.chain(node.url, "late") as chain:
                await chain.lighthouses.become_provider(market.deployment.lighthouse, 10**9)
            await says(server, " serves airalab.lighthouse")


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
    with started(*edge, says=FILES + str(folder.certificate), variables=variables) as server:
        away.rename(folder.certificate)
        await says(server, "waiting for a router: no Zenoh router at")
        with site.open_router("wheel"):
            await says(server, "edge of 0x")


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
    with started(*AIRA, "router", says=FILES + str(site.roster), variables=variables) as server:
        shutil.move(away, site.roster)
        await says(server, f"listens at {site.endpoint}")


async def test_an_agent_that_is_not_let_in_waits_until_it_is(tmp_path: Path) -> None:
    """A certificate that the router does not take yet, as its site is made anew."""
    (tmp_path / "other").mkdir()
    site, other = ClosedSite(tmp_path), ClosedSite(tmp_path / "other")
    with Anvil() as node:
        await deploy_market(node.url, node.private_keys)
        account = Account.from_key(node.private_keys[1])
        await asyncio.to_thread(hand_over, tmp_path, key=node.private_keys[1])
        mine = site.enlist(Member(name="robot", address=account.address, roles=("agent",)))
        member = other.certify("robot", account.address, "agent")
        variables = variables_of(tmp_path, node=node.port, router=site.port) | {
            "AIRA_CONNECT": site.endpoint,
            "AIRA_TLS_CA": str(member.ca),
            "AIRA_TLS_CERTIFICATE": str(member.certificate),
            "AIRA_TLS_KEY": str(member.key),
        }
        out = "the agent waits: rejected by the Zenoh router"
        with site.open_router("wheel"), started(*AGENT, says=out, variables=variables) as server:
            shutil.copytree(mine.path, member.path, dirs_exist_ok=True)
            await says(server, " on airalab.lighthouse")
