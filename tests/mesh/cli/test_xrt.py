"""`aira xrt`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.amounts import InvalidAmount
from mesh.chain import XRT, Account, TransactionSender, new_private_key
from mesh.chain._accounts import KeyfileError
from mesh.chain.errors import InsufficientFunds, UnknownName
from mesh.errors import ChainError, InputError
from schemas.address import shortened
from tests.support.cli.served_chain import MONEY, ServedChain, columns, write_quick_keyfile
from tests.support.commands import refused

if TYPE_CHECKING:
    from pathlib import Path

NOBODY = "0x00000000000000000000000000000000000000AA"


def held(served: ServedChain, who: str) -> int:
    return served.ask("provider", lambda chain: chain.tokens.balance(who))


@pytest.fixture
def poor(served: ServedChain, tmp_path: Path) -> dict[str, str]:
    """The variables of an account without ETH."""
    keyfile = write_quick_keyfile(tmp_path / "poor.json", new_private_key())
    return {"AIRA_KEYFILE": str(keyfile)}


def test_the_balance_of_the_settings_account_needs_no_password(served: ServedChain) -> None:
    address = served.people["robot"].address
    done = served.aira("xrt", "balance", by="robot", AIRA_KEYFILE_PASSWORD_FILE="")
    assert (done.exit_code, done.stdout) == (0, "1,000 XRT\n")
    assert served.run_json("xrt", "balance", address, by="person") == {
        "account": address,
        "token": served.deployment.xrt,
        "symbol": "XRT",
        "decimals": 9,
        "balance": str(MONEY),
    }


def test_a_transfer_is_in_xrt_unless_the_amount_ends_with_wn(served: ServedChain) -> None:
    before = held(served, served.people["person"].address)
    done = columns(served.aira("xrt", "transfer", NOBODY, "1.5").stdout)
    assert (done["sent"], done["to"]) == ("1.5 XRT", NOBODY)
    assert done["transaction"].startswith("0x")
    printed = served.run_json("xrt", "transfer", NOBODY, "7wn")
    assert (printed["amount"], printed["balance"]) == ("7", str(before - 1_500_000_007))
    assert held(served, NOBODY) == 1_500_000_007


def test_an_allowance_is_by_default_the_factorys_and_can_be_granted_and_revoked(served: ServedChain) -> None:
    assert served.run_json("xrt", "allowance")["spender"] == served.deployment.factory
    done = columns(served.aira("xrt", "approve", "airalab", "2.5").stdout)
    assert (done["spender"], done["allowance"]) == (served.deployment.lighthouse, "2.5 XRT")
    assert served.aira("xrt", "allowance", "airalab").stdout == "2.5 XRT\n"
    person = served.people["person"].address
    printed = served.run_json("xrt", "allowance", "airalab.lighthouse.5.robonomics.eth", "--owner", person, by="robot")
    assert (printed["owner"], printed["allowance"]) == (person, str(5 * XRT // 2))
    assert served.run_json("xrt", "approve", "airalab", "0")["allowance"] == "0"
    assert served.aira("xrt", "allowance", "airalab").stdout == "0 XRT\n"


def test_amounts_of_another_token_are_in_its_units(served: ServedChain) -> None:
    token = served.run(_deploy_token(served))
    assert served.aira("xrt", "balance", "--token", token, by="provider").stdout == f"123.45 XRT ({shortened(token)})\n"
    assert served.run_json("xrt", "balance", NOBODY, "--token", token, by="provider")["token"] == token


async def _deploy_token(served: ServedChain) -> str:
    """Another ERC-20, with the same code as XRT."""
    async with served.chain("provider") as chain:
        data = chain.node.creation_code("XRT", 123_450_000_000)
        assert chain.account is not None
        receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=data)
        assert receipt.contract is not None
        return receipt.contract


def test_more_than_the_balance_is_refused_before_a_transaction_is_sent(served: ServedChain) -> None:
    done = served.aira("xrt", "transfer", NOBODY, "5000")
    hint = refused(done, "balance-too-low", "5,000 XRT")
    assert "smaller amount" in hint


def test_an_amount_may_name_its_token(served: ServedChain) -> None:
    token = served.run(_deploy_token(served))
    done = served.run_json("xrt", "transfer", NOBODY, f"1.5 {token}", by="provider")
    assert (done["token"], done["amount"]) == (token, "1500000000")
    refused(served.aira("xrt", "transfer", NOBODY, "5 ETH"), InputError, "'ETH'", code="unknown-token")
    two = served.aira("xrt", "transfer", NOBODY, "5 XRT", "--token", token, by="provider")
    refused(two, InvalidAmount, "two tokens", shortened(token))


def test_an_unknown_name_is_one_clear_line(served: ServedChain) -> None:
    refused(served.aira("xrt", "balance", "no.3.robonomics.eth"), UnknownName, "no.3.robonomics.eth")
    refused(served.aira("xrt", "allowance", "nowhere"), UnknownName, "nowhere.lighthouse.3.robonomics.eth")


@pytest.mark.parametrize("what", ["lighthouse", "person"])
def test_an_address_without_a_token_is_one_clear_line(served: ServedChain, what: str) -> None:
    address = served.deployment.lighthouse if what == "lighthouse" else served.people["person"].address
    refused(served.aira("xrt", "balance", "--token", address), ChainError, address, code="not-a-token")


def test_an_account_without_eth_is_an_error(served: ServedChain, poor: dict[str, str]) -> None:
    hint = refused(served.aira("xrt", "approve", "factory", "1", **poor), InsufficientFunds, "has 0 ")
    assert "send ETH to the account" in hint


def test_an_account_without_xrt_is_an_error(served: ServedChain, poor: dict[str, str]) -> None:
    refused(served.aira("xrt", "transfer", NOBODY, "1", **poor), "balance-too-low", "0 XRT", "1 XRT")


def test_a_missing_account_is_one_clear_line(served: ServedChain) -> None:
    assert "--keyfile" in refused(served.aira("xrt", "balance", AIRA_KEYFILE=""), "account-missing")
    refused(served.aira("xrt", "transfer", NOBODY, "1", AIRA_KEYFILE=""), "account-not-set")


def test_a_missing_keyfile_and_a_wrong_password_are_one_clear_line(served: ServedChain, tmp_path: Path) -> None:
    absent = str(tmp_path / "absent.json")
    for command in (("balance",), ("transfer", NOBODY, "1")):
        hint = refused(served.aira("xrt", *command, AIRA_KEYFILE=absent), KeyfileError, absent)
        assert hint == "make one with `aira account new`"
    (tmp_path / "wrong").write_text("guessed\n")
    done = served.aira("xrt", "transfer", NOBODY, "1", AIRA_KEYFILE_PASSWORD_FILE=str(tmp_path / "wrong"))
    refused(done, "wrong-password")
    assert "guessed" not in done.output


def test_what_was_received_can_be_sent_on(served: ServedChain, tmp_path: Path) -> None:
    key = new_private_key()
    address = Account(key).address
    keyfile = write_quick_keyfile(tmp_path / "new.json", key)
    served.ask("provider", lambda chain: chain.tokens.send_eth(address, 10**18))
    assert served.aira("xrt", "transfer", address, "3").exit_code == 0
    assert served.run_json("xrt", "transfer", NOBODY, "1", AIRA_KEYFILE=str(keyfile))["balance"] == str(2 * XRT)
