"""Signed transactions of the modelled chain: those of type 2, which is what accounts of the mesh send."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import rlp  # type: ignore[import-untyped]

from mesh.dev._rpc import RpcCode, RpcError
from schemas import keccak256
from schemas.address import address_bytes
from schemas.signing import recover_keys, signer_of

TYPE_2: Final = 2


class ModelTransaction(NamedTuple):
    """A signed transaction of type 2."""

    raw: bytes
    hash: bytes
    sender: bytes
    nonce: int
    priority: int
    price: int
    """The most wei that a gas may cost."""
    gas: int
    to: bytes
    value: int
    data: bytes


@lru_cache(maxsize=10_000)
def read_transaction(raw: bytes) -> ModelTransaction:
    """A signed transaction. Raises `RpcError`."""
    try:
        if raw[0] != TYPE_2:
            raise ValueError(f"transactions of type {raw[0]} are not modelled")
        fields = rlp.decode(raw[1:])
        numbers = [int.from_bytes(field, "big") for field in fields[:5]]
        value, parity = int.from_bytes(fields[6], "big"), int.from_bytes(fields[9], "big")
        signature = fields[10].rjust(32, b"\0") + fields[11].rjust(32, b"\0")
        if len(signature) != 64 or parity > 3:
            raise ValueError("no signature")
        unsigned = keccak256(bytes([TYPE_2]) + rlp.encode(fields[:9]))
        sender = address_bytes(signer_of(recover_keys([(unsigned, signature, parity)])[0]))
    except Exception as error:
        raise RpcError(RpcCode.SERVER_ERROR, f"the transaction can't be decoded: {error}") from None
    _, nonce, priority, price, gas = numbers
    return ModelTransaction(raw, keccak256(raw), sender, nonce, priority, price, gas, fields[5], value, fields[7])
