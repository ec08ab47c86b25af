"""The liability record: what a liability contract says of itself, as agents and clients read it."""

from __future__ import annotations

from schemas.records import Record, UInt256


class Liability(Record, frozen=True, kw_only=True, rename="camel"):
    """A liability: who does what for whom, for how much, and how it ended.

    Addresses are in EIP-55, `validator` is the zero address if there is none. `model`, `objective` and `result` are
    CIDs; `result` is empty until the liability is finalized. `cost` is in the token's smallest unit, the fees in wn.
    """

    address: str
    model: str
    objective: str
    result: str
    promisee: str
    promisor: str
    lighthouse: str
    lighthouse_fee: UInt256
    token: str
    cost: UInt256
    validator: str
    validator_fee: UInt256
    is_success: bool
    is_finalized: bool
