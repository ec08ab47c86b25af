"""libsecp256k1: public keys and signatures that tell their key. Everything that signs or verifies calls it here.

`lib` and `ffi` are the bindings of coincurve; on Python 3.14 and later, for which coincurve has no builds, those of
btclib-secp256k1. Both give libsecp256k1's own functions.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
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

_UNCOMPRESSED: Final = 2
"""`SECP256K1_EC_UNCOMPRESSED`, which one of the bindings lacks."""


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
    lib.secp256k1_ec_pubkey_serialize(CONTEXT, text, size, source, _UNCOMPRESSED)
    return bytes(ffi.buffer(text)[1:])


def sign_recoverable(digest: bytes, secret: bytes) -> bytes:
    """The signature of 32 bytes: r, s (the lower one), and the recovery id from 0 to 3; deterministic (RFC 6979)."""
    signature = ffi.new("secp256k1_ecdsa_recoverable_signature *")
    if not lib.secp256k1_ecdsa_sign_recoverable(CONTEXT, signature, digest, secret, ffi.NULL, ffi.NULL):
        raise ValueError("not a private key")
    compact, recovery_id = ffi.new("unsigned char[64]"), ffi.new("int *")
    lib.secp256k1_ecdsa_recoverable_signature_serialize_compact(CONTEXT, compact, recovery_id, signature)
    return bytes(ffi.buffer(compact)) + bytes((recovery_id[0],))
