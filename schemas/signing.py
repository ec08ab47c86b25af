"""Signatures of messages and of signed records: ECDSA on secp256k1 over the hash as a personal message of Ethereum.

`verify` checks every received message once, where it enters the process. It costs one public-key recovery and little
else; addresses and CIDs, which repeat between messages, are cached.

Every signature has twins (v as 0/1, high s) that other readers accept. Here only one form is valid, so a message can't
travel under two texts.

Everything that signs or verifies calls libsecp256k1 here. `lib` and `ffi` are the bindings of coincurve; on Python 3.14
and later, for which coincurve has no builds, those of btclib-secp256k1. Both give libsecp256k1's own functions. This is
the one place that imports a private module of coincurve: its public recovery allocates three objects for each message,
takes 15 % longer, and would put the verification of messages below its bar.
"""

from __future__ import annotations

import re
import sys
import threading
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, Self, TypeAlias, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from schemas.address import ZERO_ADDRESS, checksum_address, keccak256
from schemas.cid import CACHED
from schemas.errors import InputError, InvalidMessage, InvalidRecord
from schemas.messages import (
    SIGNATURE_SIZE,
    OrderFeedback,
    Permit,
    SignedMessage,
    TransactionFeedback,
    decode,
    hex_digits,
    message_hash,
)
from schemas.records import Record

if TYPE_CHECKING:
    from collections.abc import Iterable

    ffi: Any
    lib: Any
    CONTEXT: Any
elif sys.version_info >= (3, 14):
    from btclib_secp256k1 import ffi, lib
    from btclib_secp256k1.context import ctx

    CONTEXT = ctx
else:
    from coincurve._libsecp256k1 import ffi, lib
    from coincurve.context import GLOBAL_CONTEXT

    CONTEXT = GLOBAL_CONTEXT.ctx


ORDER: Final = 0xFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFEBAAEDCE6AF48A03BBFD25E8CD0364141
"""The number of points of the curve. Private keys are smaller, and at least 1."""


def is_private_key(secret: bytes) -> bool:
    """Whether these are 32 bytes of a number from 1 to `ORDER` less one."""
    return len(secret) == 32 and 0 < int.from_bytes(secret, "big") < ORDER


def public_key(secret: bytes) -> bytes:
    """The public key of a private key, as libsecp256k1 holds it: 64 bytes whose order depends on the machine."""
    key = ffi.new("secp256k1_pubkey *")
    if not lib.secp256k1_ec_pubkey_create(CONTEXT, key, secret):
        raise ValueError("not a private key")
    return bytes(ffi.buffer(key))


def point_of(key: bytes) -> bytes:
    """The 64 bytes of x and y of a public key, which is given as libsecp256k1 holds it."""
    source, text, size = ffi.new("secp256k1_pubkey *"), ffi.new("unsigned char[65]"), ffi.new("size_t *", 65)
    ffi.memmove(source, key, len(key))
    uncompressed = 2  # SECP256K1_EC_UNCOMPRESSED, which one of the bindings lacks
    lib.secp256k1_ec_pubkey_serialize(CONTEXT, text, size, source, uncompressed)
    return bytes(ffi.buffer(text)[1:])


def sign_recoverable(digest: bytes, secret: bytes) -> bytes:
    """The signature of 32 bytes: r, s (the lower one), and the recovery id from 0 to 3; deterministic (RFC 6979)."""
    signature = ffi.new("secp256k1_ecdsa_recoverable_signature *")
    if not lib.secp256k1_ecdsa_sign_recoverable(CONTEXT, signature, digest, secret, ffi.NULL, ffi.NULL):
        raise ValueError("not a private key")
    compact, recovery_id = ffi.new("unsigned char[64]"), ffi.new("int *")
    lib.secp256k1_ecdsa_recoverable_signature_serialize_compact(CONTEXT, compact, recovery_id, signature)
    return bytes(ffi.buffer(compact)) + bytes((recovery_id[0],))


_M = TypeVar("_M", bound=SignedMessage)
_M_co = TypeVar("_M_co", bound=SignedMessage, covariant=True)

_PREFIX: Final = b"\x19Ethereum Signed Message:\n32"
_HIGHEST_S: Final = (ORDER // 2).to_bytes(32, "big")
_RECOVERY_IDS: Final = {27: 0, 28: 1}
LONGEST_DETAIL: Final = 500
"""Characters of a decline's detail."""
_WORD: Final = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_LONGEST_WORD: Final = 64


class Verified(Struct, Generic[_M_co], frozen=True, gc=False):
    """A message with its 32-byte hash and the EIP-55 address of its signer."""

    message: _M_co
    hash: bytes
    signer: str


class Signer:
    """A private key that signs messages; it never reveals the key.

    Raises `InputError` if `private_key` is not 32 bytes of a number from 1 to the order of the curve less one.
    """

    __slots__ = ("__key", "address")

    def __init__(self, private_key: bytes) -> None:
        if not is_private_key(private_key):
            raise InputError("a private key is 32 bytes, neither zero nor beyond the order of secp256k1")
        self.__key = bytes(private_key)
        self.address: Final = signer_of(public_key(self.__key))

    def __repr__(self) -> str:
        return f"Signer({self.address})"

    def __reduce__(self) -> Any:
        raise TypeError("a signer is not pickled: it would carry its key along")

    def sign(self, message: _M) -> _M:
        """The same message with this key's signature on it; deterministic (RFC 6979).

        Raises `InvalidMessage`: `unresolved-name` if the message contains an ENS name, `sender` if its sender is not
        this account.
        """
        digest = signable(message_hash(message), is_typed_data=message.is_typed_data)
        _check_sender(message, self.address)
        return replace(message, signature=self._sign(digest).hex())

    def sign_hash(self, digest: bytes) -> bytes:
        """The 65-byte signature (r, s, v = 27 or 28) of a 32-byte message hash, as a personal message of Ethereum.

        Raises `InputError` for a hash of another length.
        """
        if len(digest) != 32:
            raise InputError(f"a message hash has 32 bytes, not {len(digest)}")
        return self._sign(signable(digest))

    def _sign(self, digest: bytes) -> bytes:
        signature = sign_recoverable(digest, self.__key)
        return signature[:64] + bytes((signature[64] + 27,))


def signable(digest: bytes, *, is_typed_data: bool = False) -> bytes:
    """What a key signs for a message hash: the hash of a personal message of Ethereum; of EIP-712, the hash itself."""
    return digest if is_typed_data else keccak256(_PREFIX + digest)


def recover(digest: bytes, signature: str | bytes) -> str:
    """The EIP-55 address whose key made `signature` (65 bytes, or their hexadecimal digits) of a 32-byte message hash.

    Raises `InvalidMessage` (`signature`) for any but 65 bytes with v 27 or 28 and a low s, if no key could have made
    it, and if it gives the zero address.
    """
    return signer_of(recover_keys((signed_digest(digest, signature),))[0])


SignedDigest: TypeAlias = tuple[bytes, bytes, int]
"""What a key is recovered from: the 32 bytes that were signed, the signature's 65 bytes, and its recovery id."""


def signed_digest(digest: bytes, signature: str | bytes, *, is_typed_data: bool = False) -> SignedDigest:
    """What `recover_keys` takes for a 32-byte message hash and its signature. Raises as `recover`."""
    if isinstance(signature, str):
        try:
            signature = bytes.fromhex(signature.removeprefix("0x"))
        except ValueError:
            raise InvalidMessage("signature", "not hexadecimal") from None
    if len(signature) != SIGNATURE_SIZE:
        raise InvalidMessage("signature", f"{len(signature)} bytes, expected {SIGNATURE_SIZE}")
    if (recovery_id := _RECOVERY_IDS.get(signature[64])) is None:
        raise InvalidMessage("signature", f"v is {signature[64]}, expected 27 or 28")
    if signature[32:64] > _HIGHEST_S:
        raise InvalidMessage("signature", "s is in the upper half of the curve's order")
    return signable(digest, is_typed_data=is_typed_data), signature, recovery_id


def recover_keys(signed: Iterable[SignedDigest]) -> list[bytes]:
    """The public keys, as `signer_of` takes them; empty where no key could have made the signature.

    A recovery fills the processor's caches, so whatever else a message needs costs twice as much between two of them.
    """
    buffers = _buffers
    signature, key, key_bytes = buffers.signature, buffers.key, buffers.key_bytes
    # Zero means that r or s is out of range, or that r belongs to no point of the curve.
    return [
        key_bytes[:]
        if _parse(CONTEXT, signature, compact, recovery_id) and _recover(CONTEXT, key, signature, digest)
        else b""
        for digest, compact, recovery_id in signed
    ]


class _Buffers(threading.local):
    """What libsecp256k1 writes to: one set for each thread, because it runs without Python's lock."""

    def __init__(self) -> None:
        self.signature: Any = ffi.new("secp256k1_ecdsa_recoverable_signature *")
        self.key: Any = ffi.new("secp256k1_pubkey *")
        self.key_bytes: Any = ffi.buffer(self.key)


# The bindings' own function for this makes these calls, too, but allocates three objects for each.
_buffers: Final = _Buffers()
_parse: Final = lib.secp256k1_ecdsa_recoverable_signature_parse_compact
_recover: Final = lib.secp256k1_ecdsa_recover


def verify(payload: bytes) -> Verified[SignedMessage]:
    """Decode a message, hash it and recover its signer: all checks that need no chain.

    Raises `InvalidMessage` and nothing else, whatever the bytes are: the reasons of `wire.decode`, and `unsigned`,
    `unresolved-name`, `signature`, and `sender` if the signer of a generation-5 order is not its sender.
    """
    message = decode(payload)
    if isinstance(message, (OrderFeedback, TransactionFeedback)):
        raise InvalidMessage("unsigned", f"what is signed in a {type(message).__name__} is not defined")
    return verify_message(message)


def verify_message(message: _M) -> Verified[_M]:
    """As `verify`, for a message that is decoded already and whose ENS names are resolved."""
    digest = message_hash(message)
    signed = signed_digest(digest, message.signature, is_typed_data=message.is_typed_data)
    return verify_recovered(message, digest, recover_keys((signed,))[0])


def verify_recovered(message: _M, digest: bytes, key: bytes) -> Verified[_M]:
    """As `verify_message`, for a message whose `message_hash` is known, and what `recover_keys` gave for it."""
    signer = signer_of(key)
    _check_sender(message, signer)
    return Verified(message, digest, signer)


class SignedRecord(Record, frozen=True, kw_only=True):
    """A record with its author's signature. Anybody may publish one: check `is_signed`, and who its author is."""

    domain: ClassVar[bytes]
    """The prefix of what the signature covers; no message of the market begins like this."""
    author: ClassVar[str]
    """The field with the author's EIP-55 address."""

    signature: str = ""
    """130 hexadecimal digits."""

    def signed_by(self, signer: Signer) -> Self:
        """The same with the signature of `signer`, whose address must be the author's."""
        return replace(self, signature=signer.sign_hash(self._hash()).hex())

    @property
    def signer(self) -> str:
        address: str = getattr(self, self.author)
        return address

    @property
    def is_signed(self) -> bool:
        """Whether the signature is the author's."""
        try:
            return recover(self._hash(), self.signature) == self.signer
        except InvalidMessage:
            return False

    def _hash(self) -> bytes:
        """The hash of the JSON without the signature, whose encoding is canonical."""
        return keccak256(self.domain + replace(self, signature="").encode())


class _Statement(SignedRecord, frozen=True, kw_only=True):
    """What an account states about an order."""

    order: str
    """The order's hash: 64 hexadecimal digits."""
    detail: str
    """For people."""


class Refusal(StrEnum):
    """Why a provider refuses an order, as published to its sender."""

    EXPIRED = "expired"
    """Its deadline has passed."""
    DUPLICATE = "duplicate"
    """It is in the book already."""
    LIGHTHOUSE = "lighthouse"
    """It names another lighthouse."""
    FULL = "full"
    """The book is full; try again later."""
    WITHDRAWN = "withdrawn"
    """Its maker has withdrawn it."""
    REPLACED = "replaced"
    """Its maker has signed it again, or another version of it has become a contract."""
    UNDECIDED = "undecided"
    """A transaction with another version of it may still succeed, after a reorganisation; try again later."""
    UNPAID = "unpaid"
    """Its contract would not cover the provider's gas, and no free one is left now; try again later."""
    BLOCKED = "blocked"
    """Its maker is blocked; this is not published."""


class Rejection(_Statement, frozen=True, kw_only=True):
    """A provider's statement that it can't use an order or a result; put on `aira/{lighthouse}/reject/{maker}`.

    `reason` is a word for programs (a `Refusal` by the order book, or the name of the contracts' error), `provider` the
    EIP-55 address of the provider. Trust it only if it `is_signed` by a provider of the lighthouse.
    """

    domain: ClassVar = b"aira rejection\0"
    author: ClassVar = "provider"

    reason: str
    provider: str


class Decline(_Statement, frozen=True, kw_only=True):
    """An agent's statement that it does not work for a demand; put on `aira/{lighthouse}/decline/{maker}`.

    A bridge states with it, as `too-large`, that it does not pass a demand on to the legacy network.

    `code` is a word for programs: `unknown-topic`, `unfit-message`, or another reason why the objective does not fit;
    `objective-unavailable`, `busy`, or a word of the agent's own, as `too-cheap`. `detail` has at most `LONGEST_DETAIL`
    characters; `agent` is the EIP-55 address of the agent. Trust it only if it `is_signed` by an agent or a bridge that
    is present.
    """

    domain: ClassVar = b"aira decline\0"
    author: ClassVar = "agent"

    code: str
    agent: str

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        if hex_digits(self.order, 32) != self.order:
            raise InvalidRecord("Decline", "order: expected 64 hexadecimal digits")
        if not is_word(self.code):
            raise InvalidRecord("Decline", f"code: expected words of letters and digits, at most {_LONGEST_WORD}")
        if len(self.detail) > LONGEST_DETAIL:
            raise InvalidRecord("Decline", f"detail: expected at most {LONGEST_DETAIL} characters")


LONGEST_WHY: Final = 200
"""Characters of the reason for a stop."""


class StopRequest(SignedRecord, frozen=True, kw_only=True, omit_defaults=True):
    """A request to stop the job of `liability`, by its promisee or its promisor; `why` is for people.

    With a `code`, a word for programs, its promisor hands it back: the robot can't do it.

    To repeat one, or to send an old one again, changes nothing: a job is stopped once, and never continues.
    """

    domain: ClassVar = b"aira stop\0"
    author: ClassVar = "by"

    liability: str
    """The liability's address (EIP-55)."""
    by: str
    """The account that asks (EIP-55)."""
    why: str
    """At most `LONGEST_WHY` characters."""
    time: int
    """When it was signed (Unix time, seconds)."""
    code: str = ""

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        if self.code and not is_word(self.code):
            raise InvalidRecord("StopRequest", f"code: expected words of letters and digits, at most {_LONGEST_WORD}")
        if len(self.why) > LONGEST_WHY:
            raise InvalidRecord("StopRequest", f"why: expected at most {LONGEST_WHY} characters")


def is_word(text: str) -> bool:
    """Whether a text is a word for programs: lower-case letters, digits and single hyphens, 64 characters at most."""
    return len(text) <= _LONGEST_WORD and _WORD.fullmatch(text) is not None


def _check_sender(message: SignedMessage, signer: str) -> None:
    sender = message.owner if isinstance(message, Permit) else getattr(message, "sender", None)
    if sender is not None and sender != signer:
        raise InvalidMessage("sender", f"it names {sender} as its sender, but the key is that of {signer}")


@lru_cache(maxsize=CACHED)
def signer_of(key: bytes) -> str:
    """The address of a public key, given as the bytes of libsecp256k1's `secp256k1_pubkey`, equal for equal keys.

    Raises `InvalidMessage` (`signature`) for no key, and if its address is zero.
    """
    if not key:
        raise InvalidMessage("signature", "no key could have made it")
    address = checksum_address(keccak256(point_of(key))[12:])
    if address == ZERO_ADDRESS:
        raise InvalidMessage("signature", "the signer is the zero address")
    return address
