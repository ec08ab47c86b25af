"""Accounts: private keys that sign transactions here, and messages with `schemas.signing`.

Keyfiles are Web3 secret storage (version 3), as geth, parity and the legacy stack write them. Keys never leave this
module and are never logged or shown. eth-account, which signs, takes 20 MB and 0.4 s of CPU to import: who only reads
the chain does without it.
"""

from __future__ import annotations

import json
import secrets
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import rlp  # type: ignore[import-untyped]

from mesh.base.extras import needs_extra
from mesh.base.private_files import sync_directory, write_new
from mesh.errors import ConfigurationError, InputError
from schemas.address import address_bytes, checksum_address, keccak256, parse_address
from schemas.decoding import InvalidData, decode_json, first_line, text_of
from schemas.signing import Signer, is_private_key

if TYPE_CHECKING:
    from collections.abc import Mapping

    from eth_account import Account as EthAccount


class KeyfileLimits(NamedTuple):
    """What a keyfile may take, which may be a stranger's, and what opening it may."""

    size: int = 64 << 10
    """Bytes of it: real ones have about 500."""
    scrypt_memory: int = 512 << 20
    """Bytes of memory, 128·r·(n+p) of scrypt: twice what geth's take."""
    scrypt_work: int = 1 << 23
    """The n·r·p of scrypt: four times geth's, some seconds."""
    pbkdf2_work: int = 10_000_000
    """Iterations of PBKDF2 for each 32 bytes of the derived key: some seconds; ten times those of ours."""
    derived: range = range(32, 129)
    """Bytes that it may derive from its password; it uses 32."""


KEYFILE_LIMITS: Final = KeyfileLimits()

SUCCESSOR: Final = "successor"
"""The field of a retired keyfile with the address under which its owner goes on."""


class KeyfileError(ConfigurationError, code="keyfile-error"):
    """A keyfile or its password file can't be read or written, or is not Web3 secret storage.

    Its code says which: `keyfile-exists` (none is ever overwritten), `not-a-keyfile`, `keyfile-too-costly` (opening it
    would take more memory or time than is allowed: a stranger's may ask for any amount), `keyfile-address-wrong` (money
    sent to the stated address would not reach its owner), `keyfile-retired` (the owner has replaced the key),
    `wrong-password`, else `keyfile-error`.
    """

    def __init__(self, path: object, why: str, *, hint: str = "", code: str = "") -> None:
        super().__init__(f"{path}: {why}", hint=hint, code=code)
        self.path = str(path)


def _not_a_keyfile(path: Path, why: str, *, hint: str = "") -> KeyfileError:
    return KeyfileError(path, f"is not a keyfile: {why}", hint=hint, code="not-a-keyfile")


def _eth_account() -> type[EthAccount]:
    with needs_extra("chain", "the chain"):  # which takes back that it lets everything recurse deeper
        from eth_account import Account as EthAccount
    return EthAccount


class SignedTransaction(NamedTuple):
    """A signed transaction as bytes, and its hash (0x…)."""

    raw: bytes
    hash: str


class Account:
    """A private key (32 bytes) that signs. `repr` shows its address only. Raises `InputError` for other bytes."""

    def __init__(self, private_key: bytes) -> None:
        self.signer = Signer(private_key)
        self.__key = bytes(private_key)
        self.address: str = self.signer.address
        """EIP-55."""

    @classmethod
    def from_keyfile(cls, keyfile: Path | str, password_file: Path | str) -> Account:
        """The account of a keyfile, opened with the first line of a password file.

        Takes most of a second, by design of keyfiles. Raises `KeyfileError`.
        """
        if (successor := _read_keyfile(Path(keyfile)).get(SUCCESSOR)) is not None:
            raise KeyfileError(
                keyfile,
                f"holds a retired key: its work goes on as {str(successor)[:80]}",
                hint="name the new keyfile; to use the old key all the same, copy it with "
                "`aira account import NEW-FILE --from-keyfile`",
                code="keyfile-retired",
            )
        return cls.from_retired_keyfile(keyfile, password_file)

    @classmethod
    def from_retired_keyfile(cls, keyfile: Path | str, password_file: Path | str) -> Account:
        """The same, also of a keyfile that `retire_keyfile` has written."""
        return cls(_open_keyfile(Path(keyfile), _read_password(Path(password_file)), password_from=password_file))

    def sign_transaction(self, fields: Mapping[str, Any]) -> SignedTransaction:
        """Sign a transaction whose fields are complete, named as in JSON-RPC, with ints for quantities.

        It has two fees (EIP-1559, type 2) or, for chains without a base fee, a `gasPrice` (EIP-155).
        """
        signed = _eth_account().sign_transaction(dict(fields), self.__key)
        return SignedTransaction(raw=bytes(signed.raw_transaction), hash=signed.hash.to_0x_hex())

    def __repr__(self) -> str:
        return f"Account({self.address})"

    def __reduce__(self) -> Any:
        raise TypeError("an account is not pickled: it would carry its key along")


def new_private_key() -> bytes:
    """A new private key from the system's random source."""
    while not is_private_key(key := secrets.token_bytes(32)):
        pass  # as good as never: one in 2 ** 128
    return key


def write_keyfile(path: Path | str, private_key: bytes, password: str, *, iterations: int = 1_000_000) -> str:
    """Write a key, encrypted, to a new file that only its owner reads; the account's address.

    Takes most of a second, as does opening it: `iterations` of PBKDF2 slow down who guesses passwords. Raises
    `KeyfileError` when the file exists or can't be written, `InputError` for an invalid `private_key`.
    """
    address = Account(private_key).address
    content = _eth_account().encrypt(private_key, password, kdf="pbkdf2", iterations=iterations)
    try:
        write_new(path, json.dumps(content).encode())
    except FileExistsError:
        raise KeyfileError(
            path, "exists already", hint="keyfiles are never overwritten; choose another name", code="keyfile-exists"
        ) from None
    except OSError as error:
        raise KeyfileError(path, f"can't be written: {error.strerror}") from None
    return address


def copy_keyfile(source: Path | str, path: Path | str, *, opened_by: str, password: str, password_from: object) -> str:
    """Write the key of a keyfile, which `opened_by` opens, to a new one under another password; the account's address.

    `password_from` says where `opened_by` is from, for the error. Takes some seconds. Raises as `Account.from_keyfile`
    and `write_keyfile` do.
    """
    key = _open_keyfile(Path(source), opened_by.encode(), password_from=password_from)
    return write_keyfile(path, key, password)


def retire_keyfile(keyfile: Path, retired: Path, *, successor: str) -> None:
    """Write a copy of a keyfile that `Account.from_keyfile` refuses, unless `retired` exists. Raises `KeyfileError`."""
    content = json.dumps(_read_keyfile(keyfile) | {SUCCESSOR: successor}).encode()
    try:
        with suppress(FileExistsError):
            write_new(retired, content)
        sync_directory(retired.parent)
    except OSError as error:
        raise KeyfileError(retired, f"can't be written: {error.strerror}") from None


def keyfile_address(keyfile: Path | str) -> str | None:
    """The address that a keyfile states, without its password; None if it states none. Raises `KeyfileError`.

    That this is its key's address is known only when it is opened.
    """
    return _stated_address(Path(keyfile), _read_keyfile(Path(keyfile)))


def _stated_address(path: Path, content: Mapping[str, Any]) -> str | None:
    stated = content.get("address")
    if stated is None or stated == "":
        return None
    try:
        return parse_address("0x" + str(stated).lower().removeprefix("0x"))
    except InputError:
        raise _not_a_keyfile(path, f"it states the address {str(stated)[:80]!r}, which is none") from None


def _open_keyfile(keyfile: Path, password: bytes, *, password_from: object) -> bytes:
    """The private key in a keyfile. Raises `KeyfileError`."""
    content = _read_keyfile(keyfile)
    stated = _stated_address(keyfile, content)
    version = content.get("version")
    if version != 3:
        why = "it has no version" if version is None else f"it has version {str(version)[:20]}"
        raise _not_a_keyfile(keyfile, why, hint="keyfiles have version 3")
    try:
        _check_cost(keyfile, content["crypto"])
        key = bytes(_eth_account().decrypt(content, password))  # type: ignore[arg-type]  # it takes bytes, too
        address = Signer(key).address
    except InputError:
        raise KeyfileError(keyfile, "holds no private key") from None
    except ValueError as error:
        if "MAC" in str(error):
            raise KeyfileError(
                keyfile,
                f"the password in {password_from} does not open it",
                hint="one line with the password; a line break at its end does not count",
                code="wrong-password",
            ) from None
        raise _not_a_keyfile(keyfile, str(error)) from None
    except (KeyError, TypeError, AttributeError, ArithmeticError, NotImplementedError) as error:
        raise _not_a_keyfile(keyfile, f"it can't be read here ({error})") from None
    if stated not in (None, address):
        raise KeyfileError(
            keyfile,
            f"states the address {stated}, but its key is that of {address}",
            hint="send nothing to the stated address; to use this key all the same, correct the address in the file",
            code="keyfile-address-wrong",
        )
    return key


def _check_cost(path: Path, crypto: Mapping[str, Any]) -> None:
    """Raise `KeyfileError` (`keyfile-too-costly`) before a key is derived with more memory or work than is allowed."""

    def number(name: str) -> int:
        value = parameters[name]
        if type(value) is not int or value < 1:
            raise _not_a_keyfile(path, f"{name} is not a positive number")
        return value

    def require(actual: int, limit: int, of: str) -> None:
        if actual > limit:
            raise KeyfileError(
                path, f"opening it would cost {of} {actual:,}; the limit is {limit:,}", code="keyfile-too-costly"
            )

    parameters = crypto["kdfparams"]
    size = number("dklen")
    if size not in KEYFILE_LIMITS.derived:
        raise _not_a_keyfile(path, f"its derived key has {size} bytes (dklen), not 32")
    if crypto["kdf"] == "scrypt":
        n, r, p = number("n"), number("r"), number("p")
        require(128 * r * (n + p), KEYFILE_LIMITS.scrypt_memory, "bytes of memory (128·r·(n+p) of scrypt):")
        require(n * r * p, KEYFILE_LIMITS.scrypt_work, "work (n·r·p of scrypt):")
    elif crypto["kdf"] == "pbkdf2":
        require(number("c") * -(-size // 32), KEYFILE_LIMITS.pbkdf2_work, "iterations (c of PBKDF2):")


def _read_keyfile(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(KEYFILE_LIMITS.size + 1)
        if len(data) > KEYFILE_LIMITS.size:
            raise _not_a_keyfile(path, f"it has more than {KEYFILE_LIMITS.size:,} bytes")
        content = _in_lower_case(decode_json(text_of(data)))
    except OSError as error:
        hint = "make one with `aira account new`" if isinstance(error, FileNotFoundError) else ""
        raise KeyfileError(path, f"can't read the keyfile: {error.strerror}", hint=hint) from None
    except InvalidData as error:  # which may quote the key
        why = str(error) if error.reason == "not-text" else "not JSON"
        raise KeyfileError(path, f"is not a keyfile: {why}", hint=error.hint, code="not-a-keyfile") from None
    if not isinstance(content, dict):
        raise _not_a_keyfile(path, "not a JSON object")
    return content


def _in_lower_case(content: Any) -> Any:
    """The same with names in lower case: some programs write `Crypto` and `KDF`."""
    if not isinstance(content, dict):
        return content
    return {name.lower(): _in_lower_case(member) for name, member in content.items()}


def _read_password(path: Path) -> bytes:
    try:
        return first_line(path.read_bytes())
    except OSError as error:
        raise KeyfileError(path, f"can't read the password file: {error.strerror}") from None
    except InvalidData as error:
        raise KeyfileError(path, f"can't use the password file: {error}", hint=error.hint) from None


def created_address(sender: str, nonce: int) -> str:
    """The address of the contract that an account's transaction with this nonce deploys."""
    return checksum_address(keccak256(rlp.encode([address_bytes(sender), nonce]))[12:])
