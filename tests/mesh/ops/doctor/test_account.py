"""The account on the chain: its keyfile, and its ether, tokens, allowance, stake and turn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.amounts import ETH, Unit
from mesh.chain import XRT, Account, Chain, DeploymentPlan, deploy, new_private_key, write_keyfile
from mesh.ops.doctor import CheckStatus, DoctorContext
from mesh.ops.doctor._chain import APPROVAL_LIMITS, at_least
from mesh.settings import Settings
from tests.support.cli.served_chain import PASSWORD, TIMING, write_quick_keyfile
from tests.support.doctor.examining import examined
from tests.support.node_providers import Provider, ProviderServer
from tests.support.tokens import block, deploy_blocking_token

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.doctor.machines import Machine
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter


LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"


async def test_a_wrong_password_is_named_and_not_shown(machine: Machine) -> None:
    settings = machine.settings("robot")
    (machine.folder / "password").write_text("open barley\n")

    found = await examined(DoctorContext(settings=settings, requested_role="agent"))

    cause = found.cause("keyfile")
    assert cause.code == "wrong-password"
    assert "barley" not in cause.message + cause.hint
    assert "ether" not in found


async def test_a_keyfile_that_others_may_read_is_a_warning(machine: Machine) -> None:
    settings = machine.settings("robot")
    (machine.folder / "password").chmod(0o644)

    result = (await examined(DoctorContext(settings=settings, requested_role="agent"))).one("keyfile")

    assert (result.status, result.code) == (CheckStatus.WARN, "keyfile-readable")
    assert result.hint == f"chmod 600 {machine.folder / 'password'}"


async def test_a_missing_keyfile_is_named(machine: Machine) -> None:
    settings = machine.settings("robot", keyfile=str(machine.folder / "lost.json"))

    cause = (await examined(DoctorContext(settings=settings, requested_role="agent"))).cause("keyfile")
    assert cause.code == "keyfile-error"
    assert "lost.json" in cause.message


def poor(machine: Machine) -> dict[str, Any]:
    """The settings of an account that has nothing."""
    keyfile = write_quick_keyfile(machine.folder / "poor.json", new_private_key())
    keyfile.chmod(0o600)
    return {"keyfile": str(keyfile)}


async def test_an_account_without_ether_is_reported_if_it_pays_gas(machine: Machine) -> None:
    person = await machine.examined("person", "robot", **poor(machine))
    agent = await machine.examined("agent", "robot", **poor(machine))

    assert {"ether", "tokens", "allowance"} == set(person.failed)
    assert [person.one(name).code for name in ("ether", "tokens", "allowance")] == [
        "no-gas",
        "no-tokens",
        "no-allowance",
    ]
    assert agent.failed == []
    assert (agent.one("ether").status, agent.one("ether").code) == (CheckStatus.WARN, "no-gas")


async def test_a_provider_without_a_stake_gets_a_hint(machine: Machine) -> None:
    found = await machine.examined("provider", "stranger")

    cause = found.cause("stake")
    assert cause.code == "no-stake"
    assert LIGHTHOUSE in cause.message
    assert "aira lighthouse join" in cause.hint
    assert "turn" not in found


async def test_a_missing_allowance_is_named_with_the_command_that_gives_it(machine: Machine) -> None:
    person = await machine.examined("person", "person")
    machine.town.ask("person", lambda chain: chain.tokens.approve(chain.factory, 0))
    try:
        without = await machine.examined("person", "person")
    finally:
        machine.town.ask("person", lambda chain: chain.tokens.approve(chain.factory, 1_000 * XRT))

    assert person.one("allowance").code == "ok"
    assert "1,000 XRT" in person.one("allowance").message
    result = without.one("allowance")
    assert (result.status, result.code) == (CheckStatus.WARN, "no-allowance")
    assert "`aira xrt approve factory AMOUNT`" in result.hint


async def test_what_a_token_refused_to_pay_is_named_with_the_command_that_claims_it(machine: Machine) -> None:
    person = machine.town.people["person"].address

    async def refuse(chain: Chain) -> str:
        token = await deploy_blocking_token(chain, 100)
        await block(chain, token, person)
        return token

    token = machine.town.ask("person", refuse)
    machine.town.finalize(machine.town.create_liability(cost=30, token=token), success=False)

    result = (await machine.examined("person", "person", erc20_token=token)).one("tokens")
    assert (result.status, result.code) == (CheckStatus.WARN, "tokens-owed")
    assert "is owed 30 units (0x" in result.message
    assert "aira liability claim" in result.hint


async def test_allowances_to_others_are_named_with_the_command_that_takes_them_back(machine: Machine) -> None:
    old = Account(bytes(31) + b"\7").address
    machine.town.ask("person", lambda chain: chain.tokens.approve(old, 5 * XRT))
    try:
        given = (await machine.examined("person", "person")).one("other allowances")
    finally:
        machine.town.ask("person", lambda chain: chain.tokens.approve(old, 0))
    taken_back = (await machine.examined("person", "person")).one("other allowances")

    assert (given.status, given.code) == (CheckStatus.WARN, "other-allowances")
    assert f"{old} 5 XRT; its approvals since block 0" in given.message
    assert f"`aira xrt approve {old} 0`" in given.hint
    assert taken_back.code == "ok"
    assert "since block 0" in taken_back.message


async def test_allowances_are_looked_for_in_as_many_blocks_as_the_node_answers_for(machine: Machine) -> None:
    head = machine.town.ask("person", lambda chain: chain.block_number())
    async with ProviderServer(Provider(max_range=1), machine.town.url).serving() as node:
        result = (await machine.examined("person", "person", web3_http_provider=node.url)).one("other allowances")
    answered = APPROVAL_LIMITS.searches - node.refused["eth_getLogs"]
    assert result.code == "ok"
    assert 0 < answered < APPROVAL_LIMITS.searches
    assert f"since block {head + 1 - answered} " in result.message


async def test_the_turn_of_another_provider_is_reported(router: EmbeddedRouter, anvil: Anvil, tmp_path: Path) -> None:
    first, second = (Account(key) for key in anvil.private_keys[:2])
    plan = DeploymentPlan(timeout_blocks=100)
    deployed = await deploy(anvil.url, first, plan=plan)
    for account in (first, second):
        async with Chain(anvil.url, account=account, timing=TIMING) as chain:
            if account is first:
                await chain.tokens.transfer(second.address, 100 * XRT)
            await chain.lighthouses.become_provider(deployed.lighthouse, 10 * XRT)
    write_keyfile(tmp_path / "second.json", anvil.private_keys[1], PASSWORD)
    (tmp_path / "password").write_text(PASSWORD)
    (tmp_path / "password").chmod(0o600)
    settings = Settings(
        connect=(router.endpoint,),
        web3_http_provider=anvil.url,
        data_dir=str(tmp_path),
        keyfile=str(tmp_path / "second.json"),
        keyfile_password_file=str(tmp_path / "password"),
        lighthouse_contract=deployed.lighthouse_name,
    )

    found = await examined(DoctorContext(settings=settings, requested_role="provider"))

    assert found.failed == []
    assert found.one("turn").code == "other-turn"
    assert f"{first.address} (1 of 2)" in found.one("turn").message


async def test_gas_above_the_own_ceiling_is_named(machine: Machine) -> None:
    found = await machine.examined("person", "person", max_fee_gwei=1e-9)

    assert found.cause("ether").code == "fee-too-high"


@pytest.mark.parametrize(
    ("wei", "asked"),
    [(1, "0.000000001 ETH"), (1_000_000_001, "0.000000002 ETH"), (10**18, "1 ETH"), (5 * 10**14, "0.0005 ETH")],
)
def test_a_requested_amount_is_never_less_than_needed(wei: int, asked: str) -> None:
    assert at_least(wei, ETH) == asked


def test_a_requested_amount_of_a_coin_with_few_decimals_is_exact() -> None:
    assert at_least(1_500_000_001, Unit("XRT", 9)) == "1.500000001 XRT"


async def test_a_validator_of_its_own_account(machine: Machine) -> None:
    found = await machine.examined("validator", "robot")
    result = found.one("validator")
    assert (result.status, result.code) == (CheckStatus.OK, "own-account")


async def test_a_validator_contract_that_is_none_gets_a_hint(machine: Machine) -> None:
    lighthouse = (await machine.examined("validator", "robot", validator_contract=LIGHTHOUSE)).cause("validator")
    assert lighthouse.code == "not-a-validator"
    assert "aira validator deploy" in lighthouse.hint
    nothing = await machine.examined("validator", "robot", validator_contract="0x" + "11" * 20)
    assert nothing.cause("validator").code == "not-a-validator"
