"""Accounts and keyfiles."""

from __future__ import annotations

import hashlib
import json
import logging
import pickle
import stat
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest
import rlp  # type: ignore[import-untyped]
from Crypto.Cipher import AES
from Crypto.Util import Counter
from eth_account import Account as EthAccount
from hypothesis import given
from hypothesis import strategies as st

from mesh.chain import Account, KeyfileError, keyfile_address, new_private_key, write_keyfile
from mesh.chain._accounts import (
    created_address,
)
from mesh.errors import ConfigurationError, InputError
from schemas.address import address_bytes, checksum_address, keccak256
from schemas.signing import recover

if TYPE_CHECKING:
    from collections.abc import Iterator
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


@contextmanager
def refused(code: str, *, match: str | None = None) -> Iterator[None]:
    """Expect that a keyfile is refused with this code."""
    with pytest.raises(KeyfileError, match=match) as caught:
        yield
    assert caught.value.code == code


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
        signed = Account(KEY).sign_transaction(fields | {"data": form})
        assert signed.raw == expected.raw_transaction
        assert signed.hash == "0x" + expected.hash.hex()


def test_an_account_has_the_address_of_its_key() -> None:
    assert Account(KEY).address == ADDRESS


@pytest.mark.parametrize("key", [b"", bytes(32), b"\xff" * 32, KEY + b"\0"])
def test_invalid_keys_are_refused_and_not_shown(key: bytes) -> None:
    with pytest.raises(InputError) as caught:
        Account(key)
    assert not key or key.hex() not in str(caught.value)


def test_new_keys_are_valid_and_unique() -> None:
    keys = {new_private_key() for _ in range(5)}
    assert len(keys) == 5
    assert all(Account(key).address for key in keys)


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
    with pytest.raises(KeyfileError) as caught:
        write_keyfile(keyfile, new_private_key(), "other")
    assert (caught.value.code, caught.value.path) == ("keyfile-exists", str(keyfile))
    assert keyfile.read_bytes() == before


def test_a_keyfiles_address_is_read_without_the_password(keyfile: Path) -> None:
    assert keyfile_address(keyfile) == ADDRESS


def test_a_wrong_password_is_an_error_that_does_not_show_it(keyfile: Path, tmp_path: Path) -> None:
    password_file = _password_file(tmp_path, "mellon")
    with pytest.raises(KeyfileError) as caught:
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
    with pytest.raises(KeyfileError) as caught:
        Account.from_keyfile(path, _password_file(tmp_path, "x"))
    assert (caught.value.code, caught.value.path) == ("not-a-keyfile", str(path))


def _changed(folder: Path, content: dict[str, Any], **fields: object) -> Path:
    """A keyfile with other fields; those of its parameters are named with `kdf_`."""
    changed = json.loads(json.dumps(content))
    for name, value in fields.items():
        place = changed["crypto"]["kdfparams"] if name.startswith("kdf_") else changed
        place[name.removeprefix("kdf_")] = value
    path = folder / "changed.json"
    path.write_text(json.dumps(changed))
    return path


@pytest.mark.parametrize(
    ("fields", "limit"),
    [
        ({"kdf_n": 2**24, "kdf_r": 8, "kdf_p": 1}, "536,870,912"),
        ({"kdf_n": 2, "kdf_r": 2**30, "kdf_p": 1}, "536,870,912"),
        ({"kdf_n": 2, "kdf_r": 8, "kdf_p": 2**27}, "536,870,912"),
        ({"kdf_n": 2**18, "kdf_r": 8, "kdf_p": 5}, "8,388,608"),
        ({"kdf_n": 2**4000, "kdf_r": 8, "kdf_p": 1}, "536,870,912"),
    ],
)
def test_a_keyfile_that_asks_for_too_much_memory_or_work_is_refused(
    tmp_path: Path, fields: dict[str, int], limit: str
) -> None:
    begun = time.process_time()
    with refused("keyfile-too-costly", match=limit):
        Account.from_keyfile(_changed(tmp_path, GETH, **fields), _password_file(tmp_path, "x"))
    assert time.process_time() - begun < 1


@pytest.mark.parametrize(
    "fields", [{"kdf_c": 2**31 - 1}, {"kdf_c": 10_000_001}, {"kdf_c": 4 * 10**6, "kdf_dklen": 128}]
)
def test_a_keyfile_that_asks_for_hours_of_pbkdf2_is_refused(
    keyfile: Path, tmp_path: Path, fields: dict[str, int]
) -> None:
    with refused("keyfile-too-costly", match="10,000,000"):
        Account.from_keyfile(
            _changed(tmp_path, json.loads(keyfile.read_text()), **fields), _password_file(tmp_path, "x")
        )


@pytest.mark.parametrize(
    "fields",
    [
        {"kdf_dklen": 2**30},
        {"kdf_dklen": 16},
        {"kdf_n": "262144"},
        {"kdf_n": True},
        {"kdf_p": 0},
        {"kdf_r": -8},
        {"kdf_n": 3},
        {"kdf_n": 2.5},
        {"kdf_salt": 5},
        {"address": "0x12"},
        {"address": {}},
        {"crypto": []},
        {"crypto": {"kdf": "scrypt", "kdfparams": 5}},
        {"padding": " " * 70_000},
    ],
)
def test_parameters_that_no_keyfile_has_are_refused(tmp_path: Path, fields: dict[str, object]) -> None:
    with refused("not-a-keyfile"):
        Account.from_keyfile(_changed(tmp_path, GETH, **fields), _password_file(tmp_path, "testpassword"))


def test_deep_json_is_no_keyfile(tmp_path: Path) -> None:
    path = tmp_path / "deep.json"
    path.write_text("[" * 60_000)
    with refused("not-a-keyfile"):
        keyfile_address(path)


def test_a_keyfile_that_states_another_address_than_that_of_its_key_is_refused(tmp_path: Path) -> None:
    path = _changed(tmp_path, GETH, address="00" * 20)
    with pytest.raises(KeyfileError) as caught:
        Account.from_keyfile(path, _password_file(tmp_path, "testpassword"))
    assert "0x0000000000000000000000000000000000000000" in str(caught.value)
    assert "0x008AeEda4D805471dF9b2A5B0f38A0C3bCBA786b" in str(caught.value)


@pytest.mark.parametrize("stated", ["", None, "0x008AEEDA4D805471DF9B2A5B0F38A0C3BCBA786B"])
def test_keyfiles_need_not_state_their_address_and_may_do_it_in_any_case(tmp_path: Path, stated: str | None) -> None:
    path = _changed(tmp_path, GETH, address=stated)
    expected = "0x008AeEda4D805471dF9b2A5B0f38A0C3bCBA786b"
    assert keyfile_address(path) == (expected if stated else None)
    assert Account.from_keyfile(path, _password_file(tmp_path, "testpassword")).address == expected


@pytest.mark.parametrize(("n", "r", "p"), [(262_144, 8, 1), (131_072, 8, 1), (4_096, 8, 6)])
def test_keyfiles_of_other_programs_open(tmp_path: Path, n: int, r: int, p: int) -> None:
    """As geth writes them, ethers with names in capitals, and geth in its light form."""
    derived = hashlib.scrypt(b"sesame", salt=b"salt", n=n, r=r, p=p, dklen=32, maxmem=1 << 30)
    cipher = AES.new(derived[:16], AES.MODE_CTR, counter=Counter.new(128, initial_value=7))
    sealed = cipher.encrypt(KEY)
    content = {
        "address": ADDRESS[2:].lower(),
        "Crypto": {
            "cipher": "aes-128-ctr",
            "cipherparams": {"iv": f"{7:032x}"},
            "ciphertext": sealed.hex(),
            "KDF": "scrypt",
            "kdfparams": {"salt": b"salt".hex(), "n": n, "dklen": 32, "p": p, "r": r},
            "mac": keccak256(derived[16:32] + sealed).hex(),
        },
        "id": "3198bc9c-6672-5ab3-d995-4942343ae5b6",
        "version": 3,
        "x-ethers": {"client": "ethers.js", "path": "m/44'/60'/0'/0/0"},
    }
    path = tmp_path / "other.json"
    path.write_text(json.dumps(content))
    assert Account.from_keyfile(path, _password_file(tmp_path, "sesame")).address == ADDRESS


@pytest.mark.parametrize(("version", "says"), [(None, "it has no version"), (9, "it has version 9")])
def test_a_keyfile_of_another_version_is_named(keyfile: Path, tmp_path: Path, version: int | None, says: str) -> None:
    content = json.loads(keyfile.read_text())
    del content["version"]
    path = tmp_path / "key.json"
    path.write_text(json.dumps(content if version is None else content | {"version": version}))
    with refused("not-a-keyfile", match=says):
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
        pickle.dumps(Account(KEY))


@pytest.mark.parametrize("nonce", [0, 1, 127, 128, 255, 256, 65_535, 65_536, 2**40])
def test_the_address_of_a_new_contract_is_known_before_it_exists(nonce: int) -> None:
    sender = Account(new_private_key()).address
    expected = keccak256(rlp.encode([address_bytes(sender), nonce]))[12:]
    assert created_address(sender, nonce) == checksum_address(expected)
