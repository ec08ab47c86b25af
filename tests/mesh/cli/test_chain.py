"""`aira chain deploy` and `aira chain status`."""

from __future__ import annotations

import json
import tomllib
from typing import TYPE_CHECKING

import pytest

from mesh.amounts import InvalidAmount
from mesh.chain import XRT, Account, Chain, DeploymentPlan, Node, TransactionSender, deploy, new_private_key
from mesh.chain._abi import is_code_of, load_artifact
from mesh.chain.errors import InsufficientFunds, NoContracts, NodeUnreachable, RequestRefused
from mesh.chain.rpc import HttpTransport
from mesh.cli.chain import DEPLOYMENT_GAS
from mesh.errors import ConfigurationError, InvalidAddress
from mesh.settings.chains import CHAINS
from tests.mesh.chain.conftest import OneAtATime
from tests.support.cli.served_chain import ServedChain, columns, write_quick_keyfile
from tests.support.commands import invoke, refused
from tests.support.nodes import Anvil
from tests.support.ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.errors import AiraError

DEPLOY = ("chain", "deploy", "--lighthouse", "first", "--minimal-stake", "2.5", "--timeout-blocks", "7")


@pytest.fixture
def bare(tmp_path: Path) -> Iterator[ServedChain]:
    """A served chain on which nothing was deployed."""
    with ServedChain(tmp_path, is_deployed=False) as place:
        yield place


def test_a_deployment_prints_all_addresses_and_the_settings_to_use_it(bare: ServedChain, tmp_path: Path) -> None:
    done = bare.aira(*DEPLOY)
    assert done.exit_code == 0, done.output
    facts, _, options = done.stdout.partition("\nsettings to use these contracts:\n\n")
    said = columns(facts)
    gas = int(said["gas used"].replace(",", ""))
    assert 0.7 * DEPLOYMENT_GAS < gas < DEPLOYMENT_GAS, "the balance required before the deployment matches its gas"
    (tmp_path / "aira.toml").write_text(options)
    settings = tomllib.loads(options)
    assert settings["ens_contract"] == said["ENS registry"]
    assert settings["web3_http_provider"] == bare.url
    variables = {"AIRA_CONFIG": str(tmp_path / "aira.toml"), "AIRA_WEB3_HTTP_PROVIDER": bare.url}
    status = columns(bare.aira("chain", "status", **variables).stdout)
    assert status["factory"] == said["factory"]
    assert status["XRT"] == said["XRT"]
    assert status["lighthouse"] == said["lighthouse"]
    assert status["account"].endswith(" ETH, 1,000,000 XRT")
    market = bare.run_json("lighthouse", "info", **variables)
    assert (market["minimalStake"], market["timeoutBlocks"]) == (str(5 * XRT // 2), 7)


def test_a_second_deployment_needs_a_flag(bare: ServedChain) -> None:
    first = bare.run_json(*DEPLOY, by="provider")
    hint = refused(bare.aira(*DEPLOY, by="provider"), "already-deployed", first["factory"])
    assert "--again" in hint
    second = bare.run_json(*DEPLOY, "--again", by="provider")
    assert second["factory"] != first["factory"]
    assert second["settings"]["ens_contract"] == second["ens"] != first["ens"]
    printed = bare.run_json("chain", "status", AIRA_ENS_CONTRACT=second["ens"])
    assert (printed["factory"], printed["isOurCode"]) == (second["factory"], True)


def test_a_deployment_that_was_interrupted_is_continued(bare: ServedChain) -> None:
    account = bare.people["provider"].account
    plan = DeploymentPlan(lighthouse="first", minimal_stake=5 * XRT // 2, timeout_blocks=7)

    async def interrupted() -> None:
        transport = HttpTransport(bare.url)
        node = OneAtATime(transport)
        try:
            for _ in range(20):
                node.allow()
                with pytest.raises(RequestRefused):
                    await deploy(node, account, plan=plan)
        finally:
            await transport.close()

    bare.run(interrupted())
    done = bare.aira(*DEPLOY, "--json", by="provider")
    assert done.exit_code == 0, done.output
    assert "continuing a deployment that was interrupted" in done.stderr
    deployed = json.loads(done.stdout)
    assert deployed["blockNumber"] == 22
    assert deployed["lighthouseName"] == "first.lighthouse.3.robonomics.eth"
    assert "already has the contracts" in bare.aira(*DEPLOY, by="provider").stderr


def test_an_account_that_can_not_pay_for_everything_deploys_nothing(bare: ServedChain, tmp_path: Path) -> None:
    key = new_private_key()
    keyfile = write_quick_keyfile(tmp_path / "poor.json", key)
    address = Account(key).address

    async def give() -> None:
        async with bare.chain("person").node as node:
            await TransactionSender(node, bare.people["person"].account).send(to=address, data=b"", value=10**15)

    bare.run(give())
    hint = refused(bare.aira(*DEPLOY, AIRA_KEYFILE=str(keyfile)), InsufficientFunds, address, "0.001 ETH")
    assert "send ETH" in hint
    assert columns(bare.aira("chain", "status").stdout)["block"].startswith("1, ")


@pytest.mark.parametrize(
    ("options", "error", "value"),
    [
        (("--lighthouse", "Bad Name"), "invalid-lighthouse", "Bad Name"),
        (("--minimal-stake", "0"), "invalid-lighthouse", "0 XRT"),
        (("--minimal-stake", "much"), InvalidAmount, "much"),
    ],
)
def test_values_that_the_factory_would_refuse_are_refused_before_the_first_transaction(
    bare: ServedChain, options: tuple[str, str], error: type[AiraError], value: str
) -> None:
    refused(bare.aira(*DEPLOY, *options), error, value)
    assert columns(bare.aira("chain", "status").stdout)["block"].startswith("0, ")


def test_a_deployment_needs_an_account_and_a_node(bare: ServedChain) -> None:
    refused(bare.aira(*DEPLOY, AIRA_KEYFILE=""), "account-not-set")
    nowhere = f"http://127.0.0.1:{free_port()}"
    refused(bare.aira(*DEPLOY, AIRA_WEB3_HTTP_PROVIDER=nowhere), NodeUnreachable, nowhere)


def test_status_of_a_chain_without_contracts_shows_the_node_and_what_is_missing(bare: ServedChain) -> None:
    done = bare.aira("chain", "status")
    assert done.exit_code == 1
    said = columns(done.stdout)
    assert said["node"].startswith(bare.url)
    assert said["block"].startswith("0, ")
    assert said["account"] == f"{bare.people['person'].address}  1,000,000 ETH"
    assert "factory" not in said
    line, hint = done.stderr.splitlines()
    assert line.endswith(f"[{NoContracts.code}]")
    assert "aira chain deploy" in hint


def test_status_shows_the_node_the_contracts_and_the_account(served: ServedChain) -> None:
    said = columns(served.aira("chain", "status").stdout)
    deployment = served.deployment
    assert said["node"] == f"{served.url}  aira-embedded/py-evm"
    assert said["base fee"].endswith(" gwei")
    assert said["contracts"] == "this project's code"
    assert (said["ENS registry"], said["factory"], said["XRT"]) == (deployment.ens, deployment.factory, deployment.xrt)
    assert said["lighthouse"] == f"{deployment.lighthouse}  airalab.lighthouse.3.robonomics.eth"
    assert said["account"].startswith(served.people["person"].address)
    assert said["account"].endswith(" ETH, 1,000 XRT")


def test_status_prints_json(served: ServedChain) -> None:
    printed = served.run_json("chain", "status")
    assert (printed["node"], printed["isOurCode"], printed["wn"]) == (served.url, True, str(1_000 * XRT))
    assert printed["chainId"] == served.ask("person", _chain_id)
    without = served.run_json("chain", "status", AIRA_KEYFILE="")
    assert (without["account"], without["wei"], without["wn"]) == (None, None, None)


async def _chain_id(chain: Chain) -> int:
    return chain.chain_id


def test_status_works_with_an_unknown_lighthouse(served: ServedChain) -> None:
    said = columns(served.aira("chain", "status", "--lighthouse-contract", "nowhere").stdout)
    assert said["lighthouse"] == "not found:  nowhere"
    assert served.run_json("chain", "status", "--lighthouse-contract", "nowhere")["lighthouse"] is None


def test_contracts_with_other_code_are_not_reported_as_this_projects(served: ServedChain) -> None:
    printed = served.run_json("chain", "status", AIRA_FACTORY_CONTRACT=served.deployment.lighthouse)
    assert printed["isOurCode"] is False


def test_code_is_this_projects_if_only_immutables_differ(served: ServedChain) -> None:
    code = bytes(served.ask("person", _factory_code))
    runtime = load_artifact("Factory").runtime
    assert code != runtime
    assert is_code_of("Factory", code)
    assert is_code_of("Factory", runtime)
    same = next(at for at in range(100, len(code)) if code[at])
    assert not is_code_of("Factory", code[:same] + bytes([code[same] ^ 1]) + code[same + 1 :])
    assert not is_code_of("Factory", code[:-1])
    assert not is_code_of("XRT", code)


async def _factory_code(chain: Chain) -> bytes:
    return await chain.node.code(chain.factory)


def test_contracts_can_be_deployed_to_an_external_node(tmp_path: Path) -> None:
    with Anvil() as node:
        keyfile = write_quick_keyfile(tmp_path / "deployer.json", node.private_keys[3])
        (tmp_path / "password").write_text("open sesame\n")
        variables = {
            "AIRA_WEB3_HTTP_PROVIDER": node.url,
            "AIRA_KEYFILE": str(keyfile),
            "AIRA_KEYFILE_PASSWORD_FILE": str(tmp_path / "password"),
            "AIRA_DATA_DIR": str(tmp_path / "state"),
        }
        done = invoke(*DEPLOY, "--json", **variables)
        assert done.returncode == 0, done.stderr
        printed = json.loads(done.stdout)
        status = invoke("chain", "status", "--json", **variables, AIRA_ENS_CONTRACT=printed["ens"])
        assert json.loads(status.stdout)["isOurCode"] is True


ON_A_CHAIN = [
    ("account", "show", "--balance"),
    ("xrt", "balance"),
    ("xrt", "allowance"),
    ("xrt", "approve", "factory", "1"),
    ("xrt", "transfer", "0x00000000000000000000000000000000000000AA", "1"),
    ("lighthouse", "list"),
    ("lighthouse", "info"),
    ("lighthouse", "create", "new"),
    ("lighthouse", "join", "1"),
    ("lighthouse", "leave"),
    ("liability", "list"),
    ("liability", "show", "0x00000000000000000000000000000000000000AA"),
    ("liability", "watch"),
    ("liability", "watch", "0x00000000000000000000000000000000000000AA"),
    ("liability", "cancel", "0x00000000000000000000000000000000000000AA"),
    ("validator", "deploy"),
    ("validator", "collect", "0x00000000000000000000000000000000000000AA"),
]


def test_a_chain_without_the_contracts_is_one_clear_line_in_every_command(bare: ServedChain) -> None:
    for command in ON_A_CHAIN:
        hint = refused(bare.aira(*command), NoContracts)
        assert "aira chain deploy" in hint, command


def test_a_server_that_is_no_node_is_one_clear_line(served: ServedChain) -> None:
    refused(served.aira("xrt", "balance", AIRA_WEB3_HTTP_PROVIDER="localhost"), ConfigurationError, "localhost")
    refused(served.aira("xrt", "balance", AIRA_ENS_CONTRACT="0x12"), InvalidAddress, "0x12")


@pytest.fixture
def gnosis(bare: ServedChain) -> Iterator[Anvil]:
    """A node of a chain with the number and the pace of Gnosis Chain."""

    async def mine() -> None:
        async with Node(anvil.url) as node:
            await node.request("anvil_mine", "0x32", "0x5")

    with Anvil(arguments=("--chain-id", "100")) as anvil:
        bare.run(mine())
        yield anvil


def test_the_status_shows_what_is_known_of_the_chain_and_what_overrides_it(bare: ServedChain, gnosis: Anvil) -> None:
    named = {"AIRA_WEB3_HTTP_PROVIDER": gnosis.url, "AIRA_CHAIN": "gnosis", "AIRA_POLL_INTERVAL": "3"}
    shown = bare.aira("chain", "status", AIRA_CONFIRMATIONS="7", AIRA_FINALITY="latest", **named)
    said = columns(shown.stdout)
    assert said["chain id"] == "100  Gnosis Chain (gnosis)"
    assert said["pace"] == "a block every 5 s, 5 s expected"
    assert "confirmations 7 (the chain's: 3), reorg_depth 48, poll_interval 3.0 (the chain's: 1.0)" in said["settings"]
    assert said["finality"] == "latest: what happened up to block 44 counts"
    assert said["explorer"] == "https://gnosisscan.io"
    assert said["account"].endswith(" xDAI")
    printed = json.loads(bare.aira("chain", "status", "--json", **named).stdout.splitlines()[0])
    assert (printed["chain"], printed["overridden"], printed["coin"]) == ("gnosis", {"poll_interval": 1.0}, "xDAI")
    assert printed["tokens"] == dict(CHAINS["gnosis"].tokens)


def test_the_status_of_a_known_chain_that_is_not_named_says_its_name(bare: ServedChain, gnosis: Anvil) -> None:
    said = columns(bare.aira("chain", "status", AIRA_WEB3_HTTP_PROVIDER=gnosis.url).stdout)
    assert said["chain id"] == '100  Gnosis Chain; chain = "gnosis" has its settings'
    assert said["pace"] == "a block every 5 s"


def test_a_node_of_another_chain_is_refused_in_one_line(bare: ServedChain, gnosis: Anvil) -> None:
    hint = refused(
        bare.aira("chain", "status", AIRA_WEB3_HTTP_PROVIDER=gnosis.url, AIRA_CHAIN="base"),
        "wrong-chain",
        "is on Gnosis Chain (100), not on Base (8453)",
    )
    assert "set chain to gnosis" in hint


def test_a_job_is_refunded_after_a_week_of_the_chains_blocks(bare: ServedChain) -> None:
    deployed = bare.run_json(*DEPLOY, by="provider", AIRA_CHAIN="local")

    async def delay(chain: Chain) -> int:
        factory = chain.node.contract("Factory", deployed["factory"])
        return int(await chain.node.read(factory.refundDelay()))

    assert bare.ask("provider", delay) == 7 * 86_400
