"""Signed messages of accounts that exist in tests only."""

from __future__ import annotations

from hashlib import sha256
from itertools import count
from typing import Any, Final

from schemas import (
    ZERO_ADDRESS,
    Demand,
    Liability,
    Offer,
    Result,
    Signer,
    Verified,
    Withdrawal,
    cid_of_bytes,
    message_hash,
    verify_message,
)

MARKET: Final = "airalab.lighthouse.3.robonomics.eth"
LIGHTHOUSE: Final = "0x19437Cb65760805A0e55339186F03B2d980eBBf9"
CONTRACT: Final = "0x5FbDB2315678afecb367f032d93F642f64180aa3"
TOKEN: Final = "0x27023154114b066515Ae678cb06E19417B8fcA73"
MODEL: Final = cid_of_bytes(b"a model")
OTHER_MODEL: Final = cid_of_bytes(b"another model")
OBJECTIVE: Final = cid_of_bytes(b"an objective")
RECORDING: Final = cid_of_bytes(b"a recording")

PERSON: Final = Signer(b"\x01" * 32)
ROBOT: Final = Signer(b"\x02" * 32)
STRANGER: Final = Signer(b"\x03" * 32)

_nonces = count(1)


def terms(**changes: Any) -> dict[str, Any]:
    """The fields that a demand and an offer share, with a new nonce."""
    return {
        "model": MODEL,
        "objective": OBJECTIVE,
        "token": TOKEN,
        "cost": 42,
        "lighthouse": LIGHTHOUSE,
        "validator": ZERO_ADDRESS,
        "deadline": 1_000_000,
        "nonce": sha256(next(_nonces).to_bytes(8, "big")).hexdigest(),
    } | changes


def demand(*, signer: Signer = PERSON, **changes: Any) -> Demand:
    """A signed demand; of generation 5 if `sender` and an integer `nonce` are given."""
    return signer.sign(Demand(**({"validator_fee": 0} | terms(**changes))))


def offer(*, signer: Signer = ROBOT, **changes: Any) -> Offer:
    """A signed offer, which matches a demand with the same changes."""
    return signer.sign(Offer(**({"lighthouse_fee": 0} | terms(**changes))))


def withdrawal(order: Demand | Offer, *, signer: Signer = PERSON) -> Withdrawal:
    """The signed withdrawal of an order."""
    identity = message_hash(order).hex()
    return signer.sign(Withdrawal(order=identity, lighthouse=order.lighthouse, deadline=order.deadline))


def result(*, signer: Signer = ROBOT, **changes: Any) -> Result:
    """A signed result of some liability."""
    fields: dict[str, Any] = {"liability": LIGHTHOUSE, "result": RECORDING, "success": True}
    return signer.sign(Result(**(fields | changes)))


def liability(**changes: Any) -> Liability:
    """The liability of such a demand and offer, at an address that is on no chain; its job has not ended."""
    fields: dict[str, Any] = {
        "address": CONTRACT,
        "model": MODEL,
        "objective": OBJECTIVE,
        "result": "",
        "promisee": PERSON.address,
        "promisor": ROBOT.address,
        "lighthouse": LIGHTHOUSE,
        "lighthouse_fee": 0,
        "token": TOKEN,
        "cost": 42,
        "validator": ZERO_ADDRESS,
        "validator_fee": 0,
        "is_success": False,
        "is_finalized": False,
    }
    return Liability(**(fields | changes))


def verified_demand(*, signer: Signer = PERSON, **changes: Any) -> Verified[Demand]:
    """As `demand`, verified."""
    return verify_message(demand(signer=signer, **changes))


def verified_offer(*, signer: Signer = ROBOT, **changes: Any) -> Verified[Offer]:
    """As `offer`, verified."""
    return verify_message(offer(signer=signer, **changes))
