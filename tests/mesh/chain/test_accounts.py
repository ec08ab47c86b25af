"""Accounts and keyfiles."""

from __future__ import annotations

import json
import logging
import pickle
import stat
from typing import TYPE_CHECKING

import pytest
import rlp  # type: ignore[import-untyped]
from eth_account import Account as EthAccount
from hypothesis import given
from hypothesis import strategies as st

from mesh.chain import Account, KeyfileError, WrongPassword, keyfile_address, new_private_key, write_keyfile
from mesh.chain.accounts import KeyfileExists, NotAKeyfile, created_address
from mesh.errors import ConfigurationError, InputError
from schemas.address import address_bytes, checksum_address, keccak256
from schemas.signing import recover

if TYPE_CHECKING:
    from pathlib import Path

KEY = bytes.fromhex("4c0883a69102937d6231471b5dbb6204fe5129617082792ae468d01a3f362318")
ADDRESS = "0x2c7536E3605D9C16a7a3D7b1898e529396a65c23"

GETH = {
    "address": "008aeeda4d805471df9b2a5b0f38a0c3bcba786b",
    "crypto": {
        "cipher": "aes-128-ctr",
        "ciphertext": "d172bf743a674da9cdad04534d56926ef8358534d458fffccd4e6ad2fbde479c",
        "cipherparams": {"iv": "83dbcc02d8ccb40e466191a123791e0e"},
        "kdf": "scrypt",
        "kdfparams": {
            "dklen": 32,
            "n": 262144,
            "r": 1,
            "p": 8,
            "salt": "ab0c7876052600dd703518d6fc3fe8984592145b591fc8fb5c6d43190334ba19",
        },
        "mac": "2103ac29920d71da29f15d75b4a16dbe95cfd7ff8faea1056c33131d846e3097",
    },
    "id": "3198bc9c-6672-5ab3-d995-4942343ae5b6",
    "version": 3,
}
"""The Web3 secret storage's own test vector."""


@pytest.fixture(scope="module")
def keyfile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("keys") / "key.json"
    write_keyfile(path, KEY, "sesame")
    return path


def _password_file(folder: Path, text: str) -> Path:
    path = folder / "password"
    path.write_text(text)
    return path


@given(
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**70),
    st.sampled_from([b"", bytes.fromhex(ADDRESS[2:])]),
    st.one_of(st.binary(max_size=100), st.just(bytes(70_000))),
    st.sampled_from([1, 127, 128, 31337, 2**40]),
    st.booleans(),
)
def test_transactions_are_signed_as_by_the_library(
    number: int, wei: int, to: bytes, data: bytes, chain: int, is_legacy: bool
) -> None:
    fees = {"gasPrice": wei} if is_legacy else {"type": 2, "maxFeePerGas": wei, "maxPriorityFeePerGas": number % 100}
    fields = {"nonce": number, "gas": 21_000, "to": to, "value": wei, "data": data, "chainId": chain} | fees
    expected = EthAccount.from_key(KEY).sign_transaction(fields)
    for form in (data, "0x" + data.hex()):
        signed = Account.from_key(KEY).sign_transaction(fields | {"data": form})
        assert signed.raw == expected.raw_transaction
        assert signed.hash == "0x" + expected.hash.hex()


def test_an_account_has_the_address_of_its_key() -> None:
    assert Account.from_key(KEY).address == ADDRESS


@pytest.mark.parametrize("key", [b"", bytes(32), b"\xff" * 32, KEY + b"\0"])
def test_invalid_keys_are_refused_and_not_shown(key: bytes) -> None:
    with pytest.raises(InputError) as caught:
        Account.from_key(key)
    assert not key or key.hex() not in str(caught.value)


def test_new_keys_are_valid_and_unique() -> None:
    keys = {new_private_key() for _ in range(5)}
    assert len(keys) == 5
    assert all(Account.from_key(key).address for key in keys)


def test_a_written_keyfile_opens_with_its_password(keyfile: Path, tmp_path: Path) -> None:
    account = Account.from_keyfile(keyfile, _password_file(tmp_path, "sesame\n"))
    assert account.address == ADDRESS
    assert recover(bytes(32), account.signer.sign_hash(bytes(32))) == ADDRESS


def test_a_keyfile_of_geth_opens(tmp_path: Path) -> None:
    path = tmp_path / "UTC--geth"
    path.write_text(json.dumps(GETH))
    account = Account.from_keyfile(path, _password_file(tmp_path, "testpassword"))
    assert account.address == "0x008AeEda4D805471dF9b2A5B0f38A0C3bCBA786b"


def test_only_the_owner_can_read_a_keyfile(keyfile: Path) -> None:
    assert stat.S_IMODE(keyfile.stat().st_mode) == 0o600


def test_a_keyfile_is_never_overwritten(keyfile: Path) -> None:
    before = keyfile.read_bytes()
    with pytest.raises(KeyfileExists) as caught:
        write_keyfile(keyfile, new_private_key(), "other")
    assert (caught.value.code, caught.value.path) == ("keyfile-exists", str(keyfile))
    assert keyfile.read_bytes() == before


def test_a_keyfiles_address_is_read_without_the_password(keyfile: Path) -> None:
    assert keyfile_address(keyfile) == ADDRESS


def test_a_wrong_password_is_an_error_that_does_not_show_it(keyfile: Path, tmp_path: Path) -> None:
    password_file = _password_file(tmp_path, "mellon")
    with pytest.raises(WrongPassword) as caught:
        Account.from_keyfile(keyfile, password_file)
    assert (caught.value.code, caught.value.path) == ("wrong-password", str(keyfile))
    assert str(password_file) in str(caught.value)
    assert isinstance(caught.value, ConfigurationError)
    assert caught.value.hint
    assert "mellon" not in str(caught.value)


def test_the_error_of_a_missing_keyfile_has_the_command_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(KeyfileError) as caught:
        Account.from_keyfile(tmp_path / "no.json", _password_file(tmp_path, "x"))
    assert caught.value.path == str(tmp_path / "no.json")
    assert "`aira account new`" in caught.value.hint


def test_a_missing_password_file_is_named(keyfile: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyfileError) as caught:
        Account.from_keyfile(keyfile, tmp_path / "none")
    assert (caught.value.code, caught.value.path) == ("keyfile-error", str(tmp_path / "none"))


@pytest.mark.parametrize("content", ["", "[]", "{}", '"text"', '{"version": 3, "crypto": {}}', '{"version": 9}'])
def test_a_file_that_is_not_a_keyfile_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "key.json"
    path.write_text(content)
    with pytest.raises(NotAKeyfile) as caught:
        Account.from_keyfile(path, _password_file(tmp_path, "x"))
    assert (caught.value.code, caught.value.path) == ("not-a-keyfile", str(path))


@pytest.mark.parametrize(("version", "says"), [(None, "it has no version"), (9, "it has version 9")])
def test_a_keyfile_of_another_version_is_named(keyfile: Path, tmp_path: Path, version: int | None, says: str) -> None:
    content = json.loads(keyfile.read_text())
    del content["version"]
    path = tmp_path / "key.json"
    path.write_text(json.dumps(content if version is None else content | {"version": version}))
    with pytest.raises(NotAKeyfile, match=says):
        Account.from_keyfile(path, _password_file(tmp_path, "x"))


def test_neither_key_nor_password_is_shown_or_logged(
    keyfile: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    account = Account.from_keyfile(keyfile, _password_file(tmp_path, "sesame"))
    shown = repr(account) + repr(account.signer) + repr(vars(account)) + caplog.text
    assert KEY.hex() not in shown
    assert "sesame" not in shown


def test_an_account_can_not_be_pickled() -> None:
    with pytest.raises(TypeError):
        pickle.dumps(Account.from_key(KEY))


@pytest.mark.parametrize("nonce", [0, 1, 127, 128, 255, 256, 65_535, 65_536, 2**40])
def test_the_address_of_a_new_contract_is_known_before_it_exists(nonce: int) -> None:
    sender = Account.from_key(new_private_key()).address
    expected = keccak256(rlp.encode([address_bytes(sender), nonce]))[12:]
    assert created_address(sender, nonce) == checksum_address(expected)
