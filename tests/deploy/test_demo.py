from __future__ import annotations

import json
import ssl
from typing import TYPE_CHECKING

import pytest
from aiohttp import ClientSession, CookieJar, TCPConnector
from eth_keyfile.keyfile import decode_keyfile_json

from tests.support.deployment import ComposeDeployment, Images
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.compose

SERVICES = ("setup", "chain", "router", "provider", "agent", "page", "person")


@pytest.fixture(scope="module")
def demo(images: Images, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ComposeDeployment]:
    with ComposeDeployment(images, tmp_path_factory.mktemp("demo")) as market:
        market.up()
        yield market


async def test_a_new_market_starts_and_does_a_job_that_the_logs_show(
    demo: ComposeDeployment,
) -> None:
    await demo.ready()
    assert "made" in demo.log("setup")
    story = demo.log("person")
    assert "demand by 0x" in story
    assert "paid, result Qm" in story
    assert demo.log("agent").count("the lamp is on") == 3
    liability = story.split("contract ")[1].split()[0]
    finalized = f"{liability}: finalized, success True"
    await demo.until(lambda: finalized in demo.log("provider"), what="the end in the provider's log", seconds=60)
    assert liability in demo.log("agent")


async def test_services_run_with_minimal_rights(demo: ComposeDeployment) -> None:
    await demo.ready()
    for service in SERVICES:
        facts = demo.facts(service)
        assert facts["Config"]["User"] == "10001:10001", service
        assert facts["HostConfig"]["ReadonlyRootfs"], service
        assert (facts["HostConfig"]["CapDrop"], facts["HostConfig"]["CapAdd"]) == (["ALL"], None), service
        assert not facts["HostConfig"]["Privileged"], service
        assert "no-new-privileges" in " ".join(facts["HostConfig"]["SecurityOpt"]), service
    for service in ("router", "provider", "agent", "page", "chain"):
        assert demo.execute(service, "id", "-u") == "10001\n"
        assert "CapEff:\t0000000000000000\n" in demo.execute(service, "cat", "/proc/1/status")
        assert demo.execute(service, "sh", "-c", "touch /usr/local/bin/mine 2>&1 || true").endswith(
            "Read-only file system\n"
        )


async def test_the_page_shows_the_job_to_who_logs_in(demo: ComposeDeployment) -> None:
    await demo.ready()
    context = ssl.create_default_context(cadata=demo.execute("page", "cat", "/secrets/ca.pem"))
    context.verify_flags |= ssl.VERIFY_X509_STRICT  # as Python does from 3.13 on
    url = f"https://{demo.address('page')}:8585/api/v1"
    headers = {"Host": "localhost:8585", "X-Aira-Request": "1"}
    connector = TCPConnector(ssl=context)
    async with ClientSession(connector=connector, headers=headers, cookie_jar=CookieJar(unsafe=True)) as browser:
        async with browser.get(f"{url}/liabilities", server_hostname="localhost") as closed:
            assert closed.status == 401
        token = demo.execute("page", "cat", "/secrets/browser.token")
        async with browser.post(f"{url}/session", json={"token": token}, server_hostname="localhost") as answer:
            assert (await answer.json())["role"] == "anybody"

        async def paid() -> bool:
            async with browser.get(f"{url}/liabilities", server_hostname="localhost") as answer:
                return [job["state"] for job in (await answer.json())["liabilities"]] == ["paid"]

        await until_found(paid, what="the job on the page")


async def test_no_key_and_no_password_is_in_an_environment_a_command_line_or_a_log(demo: ComposeDeployment) -> None:
    await demo.ready()
    hidden = secrets_of(demo)
    assert len(hidden) == 10
    for service in SERVICES:
        facts = demo.facts(service)
        config = facts["Config"]
        shown = [*config["Env"], *config["Cmd"], *(config["Entrypoint"] or []), *facts["Args"], demo.log(service)]
        for words in shown:
            found = [name for name, secret in hidden.items() if secret.lower() in words.lower()]
            assert not found, f"{service} shows {found}"


async def test_each_service_sees_only_its_own_secrets(demo: ComposeDeployment) -> None:
    await demo.ready()
    keys = set()
    for service in ("router", "provider", "agent"):
        keys.add(demo.execute(service, "cat", "/secrets/identity.key"))
        (volume,) = [mount["Name"] for mount in demo.facts(service)["Mounts"] if mount["Destination"] == "/secrets"]
        assert volume == f"{demo.name}_{service}-secrets"
        assert demo.execute(service, "sh", "-c", "touch /secrets/more 2>&1 || true").endswith("Read-only file system\n")
    assert len(keys) == 3


async def test_down_with_volumes_leaves_nothing(images: Images, demo: ComposeDeployment) -> None:
    await demo.ready()
    assert {left.split()[0] for left in demo.leftovers()} == {"container", "volume", "network"}
    demo.down()
    assert demo.leftovers() == []


def test_the_edge_image_has_no_chain_client(images: Images) -> None:
    look = "import importlib.util as u, serial, mesh; print(*filter(u.find_spec, ['web3', 'eth_account', 'pip']))"
    run = ["run", "--rm", "--network", "none", images.name("edge")]
    assert images.engine(*run, "python", "-c", look) == "\n"
    assert "Usage: aira edge" in images.engine(*run, "aira", "edge", "--help")


def secrets_of(market: ComposeDeployment) -> dict[str, str]:
    """The secrets by their place: passwords, accounts' private keys, and a line of each certificate's key."""
    found = {}
    for service in ("router", "provider", "agent"):
        found[f"{service}'s certificate"] = market.execute(service, "cat", "/secrets/identity.key").splitlines()[1]
    for service in ("provider", "agent"):
        keyfile = json.loads(market.execute(service, "cat", "/secrets/account.json"))
        password = market.execute(service, "cat", "/secrets/password").strip()
        found[f"{service}'s password"] = password
        found[f"{service}'s keyfile"] = keyfile["crypto"]["ciphertext"]
        found[f"{service}'s account"] = decode_keyfile_json(keyfile, password.encode()).hex()
    found["the chain's password"] = market.execute("chain", "cat", "/var/lib/aira/development/password").strip()
    return found
