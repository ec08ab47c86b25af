"""The account on the chain: its keyfile, and its ether, tokens, allowance, stake and turn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.chain import XRT, Account, Chain, DeploymentPlan, deploy, new_private_key, write_keyfile
from mesh.doctor import Case, Verdict
from mesh.settings import Settings
from tests.mesh.cli.chains import PASSWORD, TIMING, write_quick_keyfile
from tests.mesh.doctor.examining import examined

if TYPE_CHECKING:
    from pathlib import Path

    from tests.mesh.doctor.wards import Ward
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter


LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"


async def test_a_wrong_password_is_named_and_not_shown(ward: Ward) -> None:
    settings = ward.settings("robot")
    (ward.folder / "password").write_text("open barley\n")

    found = await examined(Case(settings=settings, asked_role="agent"))

    cause = found.cause("keyfile")
    assert "the password in" in cause
    assert "does not open it" in cause
    assert "barley" not in cause
    assert "ether" not in found


async def test_a_keyfile_that_others_may_read_is_a_warning(ward: Ward) -> None:
    settings = ward.settings("robot")
    (ward.folder / "password").chmod(0o644)

    finding = (await examined(Case(settings=settings, asked_role="agent"))).one("keyfile")

    assert finding.verdict is Verdict.WARN
    assert finding.do == f"chmod 600 {ward.folder / 'password'}"


async def test_a_keyfile_that_is_not_there_is_named(ward: Ward) -> None:
    settings = ward.settings("robot", keyfile=str(ward.folder / "lost.json"))

    assert "lost.json" in (await examined(Case(settings=settings, asked_role="agent"))).cause("keyfile")


def poor(ward: Ward) -> dict[str, Any]:
    """The settings of an account that has nothing."""
    keyfile = write_quick_keyfile(ward.folder / "poor.json", new_private_key())
    keyfile.chmod(0o600)
    return {"keyfile": str(keyfile)}


async def test_an_account_without_ether_is_named_where_it_has_to_pay_gas(ward: Ward) -> None:
    person = await ward.examined("person", "robot", **poor(ward))
    agent = await ward.examined("agent", "robot", **poor(ward))

    assert {"ether", "tokens", "allowance"} == set(person.failed)
    assert "has 0 ETH: gas for no transaction" in person.one("ether").found
    assert "send it " in person.one("ether").do
    assert agent.failed == []
    assert agent.one("ether").verdict is Verdict.WARN


async def test_a_provider_without_a_stake_is_told_how_to_get_one(ward: Ward) -> None:
    found = await ward.examined("provider", "stranger")

    cause = found.cause("stake")
    assert f"has no stake at the lighthouse {LIGHTHOUSE}" in cause
    assert "aira lighthouse join" in cause
    assert "turn" not in found


async def test_a_missing_allowance_is_named_with_the_command_that_gives_it(ward: Ward) -> None:
    person = await ward.examined("person", "person")
    ward.town.ask("person", lambda chain: chain.tokens.approve(chain.factory, 0))
    try:
        without = await ward.examined("person", "person")
    finally:
        ward.town.ask("person", lambda chain: chain.tokens.approve(chain.factory, 1_000 * XRT))

    assert person.one("allowance").found == "the factory may take 1,000 XRT"
    finding = without.one("allowance")
    assert finding.verdict is Verdict.WARN
    assert "the factory may take no XRT from" in finding.found
    assert "`aira xrt approve factory AMOUNT`" in finding.do


async def test_the_turn_of_another_is_told(router: EmbeddedRouter, anvil: Anvil, tmp_path: Path) -> None:
    first, second = (Account.from_key(key) for key in anvil.private_keys[:2])
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

    found = await examined(Case(settings=settings, asked_role="provider"))

    assert found.failed == []
    assert found.one("turn").found.startswith(f"{first.address}'s (1 of 2)")
    assert found.one("turn").found.endswith("this account waits for its turn")


async def test_gas_above_the_own_ceiling_is_named(ward: Ward) -> None:
    found = await ward.examined("person", "person", max_fee_gwei=1e-9)

    assert "the ceiling is 1e-09 gwei" in found.cause("ether")
