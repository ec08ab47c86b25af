"""Accounts: private keys that sign transactions here, and messages with `schemas.signing`.

Keyfiles are Web3 secret storage (version 3), as geth, parity and the legacy stack write them. Keys never leave this
module and are never logged or shown.
"""

from __future__ import annotations

import json
import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.errors import ConfigurationError, InputError
from mesh.extras import needs_extra
from schemas.address import address_bytes, checksum_address, keccak256, parse_address
from schemas.secp256k1 import is_private_key, sign_recoverable
from schemas.signing import Signer

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


VERSION: Final = 3
"""Of Web3 secret storage."""
ITERATIONS: Final = 1_000_000
"""PBKDF2 iterations between a password and the key that opens a keyfile."""
SHORT: Final = 55
"""The most bytes whose number RLP writes into one byte with their kind."""


class KeyfileError(ConfigurationError, code="keyfile-error"):
    """A keyfile or its password file can't be read or written, or is not Web3 secret storage."""

    def __init__(self, path: object, why: str, *, hint: str = "") -> None:
        super().__init__(f"{path}: {why}", hint=hint)
        self.path = str(path)


class KeyfileExists(KeyfileError, code="keyfile-exists"):
    """A keyfile of that name exists; none is ever overwritten."""


class NotAKeyfile(KeyfileError, code="not-a-keyfile"):
    """The content of a file is not Web3 secret storage."""


class WrongPassword(KeyfileError, code="wrong-password"):
    """The password does not open the keyfile."""

    def __init__(self, keyfile: object, password_file: object) -> None:
        super().__init__(
            keyfile,
            f"the password in {password_file} does not open it",
            hint="one line with the password; a line break at its end does not count",
        )


class SignedTransaction(NamedTuple):
    """A signed transaction as bytes, and its hash (0x…)."""

    raw: bytes
    hash: str


class Account:
    """A private key that signs. `repr` shows its address only."""

    def __init__(self, private_key: bytes) -> None:
        self.signer = Signer(private_key)
        self.__key = bytes(private_key)
        self.address: str = self.signer.address
        """EIP-55."""

    @classmethod
    def from_key(cls, private_key: bytes) -> Account:
        """The account of a 32-byte private key. Raises `InputError` for anything else."""
        return cls(private_key)

    @classmethod
    def from_keyfile(cls, keyfile: Path | str, password_file: Path | str) -> Account:
        """The account of a keyfile, opened with the first line of a password file.

        Takes most of a second, by design of keyfiles. Raises `KeyfileError`, `WrongPassword`.
        """
        return cls(_open_keyfile(Path(keyfile), _read_password(Path(password_file)), password_from=password_file))

    def sign_transaction(self, fields: Mapping[str, Any]) -> SignedTransaction:
        """Sign a transaction whose fields are complete, named as in JSON-RPC, with ints for quantities.

        It has two fees (EIP-1559, type 2) or, for chains without a base fee, a `gasPrice` (EIP-155).
        """
        chain, nonce = fields["chainId"], fields["nonce"]
        content = (fields["gas"], _data(fields["to"]), fields["value"], _data(fields["data"]))
        if "gasPrice" in fields:
            members: tuple[Any, ...] = (nonce, fields["gasPrice"], *content)
            *parts, parity = self._sign(keccak256(rlp((*members, chain, 0, 0))))
            raw = rlp((*members, 2 * chain + 35 + parity, *parts))
        else:
            members = (chain, nonce, fields["maxPriorityFeePerGas"], fields["maxFeePerGas"], *content, ())
            *parts, parity = self._sign(keccak256(b"\x02" + rlp(members)))
            raw = b"\x02" + rlp((*members, parity, *parts))
        return SignedTransaction(raw=raw, hash="0x" + keccak256(raw).hex())

    def _sign(self, digest: bytes) -> tuple[int, int, int]:
        """The signature of a transaction's hash: r, s, and the parity of the point."""
        signature = sign_recoverable(digest, self.__key)
        return int.from_bytes(signature[:32]), int.from_bytes(signature[32:64]), signature[64]

    def __repr__(self) -> str:
        return f"Account({self.address})"

    def __reduce__(self) -> Any:
        raise TypeError("an account is not pickled: it would carry its key along")


def rlp(value: int | bytes | Sequence[Any]) -> bytes:
    """The RLP encoding of a number, of bytes, or of several of them in a list."""
    if isinstance(value, int):
        value = value.to_bytes((value.bit_length() + 7) // 8)
    if isinstance(value, bytes):
        return value if len(value) == 1 and value[0] < 0x80 else _with_size(0x80, value)
    return _with_size(0xC0, b"".join(map(rlp, value)))


def _with_size(kind: int, content: bytes) -> bytes:
    if len(content) <= SHORT:
        return bytes((kind + len(content),)) + content
    size = len(content).to_bytes((len(content).bit_length() + 7) // 8)
    return bytes((kind + SHORT + len(size),)) + size + content


def _data(given: str | bytes) -> bytes:
    return bytes.fromhex(given.removeprefix("0x")) if isinstance(given, str) else given


def new_private_key() -> bytes:
    """A new private key from the system's random source."""
    while not is_private_key(key := secrets.token_bytes(32)):
        pass  # as good as never: one in 2 ** 128
    return key


def write_keyfile(path: Path | str, private_key: bytes, password: str, *, iterations: int = ITERATIONS) -> str:
    """Write a key, encrypted, to a new file that only its owner reads; the account's address.

    Takes most of a second, as does opening it: `iterations` of PBKDF2 slow down who guesses passwords. Raises
    `KeyfileError` when the file exists or can't be written, `InputError` for an invalid `private_key`.
    """
    with needs_extra("chain", "keyfiles"):  # takes half a second
        from eth_keyfile.keyfile import create_keyfile_json

    address = Account(private_key).address
    content = create_keyfile_json(private_key, password.encode(), iterations=iterations)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise KeyfileExists(
            path, "exists already", hint="keyfiles are never overwritten; choose another name"
        ) from None
    except OSError as error:
        raise KeyfileError(path, f"can't be written: {error.strerror}") from None
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        json.dump(content, file)
        file.flush()
        os.fsync(file.fileno())
    return address


def copy_keyfile(source: Path | str, path: Path | str, *, opened_by: str, password: str, password_from: object) -> str:
    """Write the key of a keyfile, which `opened_by` opens, to a new one under another password; the account's address.

    `password_from` says where `opened_by` is from, for the error. Takes some seconds. Raises as `Account.from_keyfile`
    and `write_keyfile` do.
    """
    key = _open_keyfile(Path(source), opened_by.encode(), password_from=password_from)
    return write_keyfile(path, key, password)


def keyfile_address(keyfile: Path | str) -> str | None:
    """The address that a keyfile states, without its password; None if it states none. Raises `KeyfileError`."""
    claimed = _read_keyfile(Path(keyfile)).get("address")
    return parse_address("0x" + claimed.removeprefix("0x").lower()) if isinstance(claimed, str) else None


def _open_keyfile(keyfile: Path, password: bytes, *, password_from: object) -> bytes:
    """The private key in a keyfile. Raises `KeyfileError`, `WrongPassword`."""
    with needs_extra("chain", "keyfiles"):  # takes half a second
        from eth_keyfile.keyfile import decode_keyfile_json

    content = _read_keyfile(keyfile)
    version = next((value for name, value in content.items() if name.lower() == "version"), None)
    if version != VERSION:
        why = "it has no version" if version is None else f"it has version {str(version)[:20]}"
        raise NotAKeyfile(
            keyfile, f"is not a keyfile that can be read here: {why}", hint=f"keyfiles have version {VERSION}"
        )
    try:
        key = decode_keyfile_json(content, password)
        Signer(key)
    except InputError:
        raise KeyfileError(keyfile, "holds no private key") from None
    except ValueError as error:
        if "MAC" in str(error):
            raise WrongPassword(keyfile, password_from) from None
        raise NotAKeyfile(keyfile, f"is not a keyfile: {error}") from None
    except (KeyError, TypeError, AttributeError, NotImplementedError) as error:
        raise NotAKeyfile(keyfile, f"is not a keyfile that can be read here ({error})") from None
    return bytes(key)


def _read_keyfile(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        hint = "make one with `aira account new`" if isinstance(error, FileNotFoundError) else ""
        raise KeyfileError(path, f"can't read the keyfile: {error.strerror}", hint=hint) from None
    except ValueError:
        raise NotAKeyfile(path, "is not a keyfile: not JSON") from None
    if not isinstance(content, dict):
        raise NotAKeyfile(path, "is not a keyfile: not a JSON object")
    return content


def _read_password(path: Path) -> bytes:
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise KeyfileError(path, f"can't read the password file: {error.strerror}") from None
    return lines[0] if lines else b""


def created_address(sender: str, nonce: int) -> str:
    """The address of the contract that an account's transaction with this nonce deploys."""
    number = nonce.to_bytes((nonce.bit_length() + 7) // 8)
    encoded = number if 0 < nonce < 0x80 else bytes([0x80 + len(number)]) + number  # RLP
    content = b"\x94" + address_bytes(sender) + encoded
    return checksum_address(keccak256(bytes([0xC0 + len(content)]) + content)[12:])
