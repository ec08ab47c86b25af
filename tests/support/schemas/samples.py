"""Messages that tests start from and spoil."""

from __future__ import annotations

import json
from typing import Any, Final

from schemas import ZERO_ADDRESS, Demand, Offer, Result, Withdrawal

MODEL: Final = "Qmb5yQNrh7KqQT3ZRU8VBfYTobF9yCLqS3UTwxAH99aE3v"
OBJECTIVE: Final = "QmXLdQvVSs5JaXoctCKQiXfbnexk6z9mFDu7sd9NFspKNK"
TOKEN: Final = "0x27023154114b066515Ae678cb06E19417B8fcA73"
LIGHTHOUSE: Final = "0x19437Cb65760805A0e55339186F03B2d980eBBf9"
LIGHTHOUSE_NAME: Final = "airalab.lighthouse.3.robonomics.eth"
SENDER: Final = "0xb313109355F6EAD7f9cEF1E2a009160993B1e193"
NONCE: Final = "a05a41f45054c690346b9925e3f328525bb5c261abc120f8851afd61b4699e53"
SIGNATURE: Final = "11" * 32 + "22" * 32 + "1b"

TERMS: Final[dict[str, Any]] = {
    "model": MODEL,
    "objective": OBJECTIVE,
    "token": TOKEN,
    "cost": 42,
    "lighthouse": LIGHTHOUSE,
    "validator": ZERO_ADDRESS,
    "deadline": 44058,
    "nonce": NONCE,
    "signature": SIGNATURE,
}
DEMAND: Final = Demand(**TERMS, validator_fee=7)
OFFER: Final = Offer(**TERMS, lighthouse_fee=7)
DEMAND_5: Final = Demand(**{**TERMS, "nonce": 3, "sender": SENDER}, validator_fee=7)
OFFER_5: Final = Offer(**{**TERMS, "nonce": 3, "sender": SENDER}, lighthouse_fee=7)
RESULT: Final = Result(liability=LIGHTHOUSE, result=MODEL, success=True, signature=SIGNATURE)
WITHDRAWAL: Final = Withdrawal(order=NONCE, lighthouse=LIGHTHOUSE, deadline=44058, signature=SIGNATURE)

DEMAND_JSON: Final[dict[str, Any]] = {**TERMS, "validatorFee": 7}
OFFER_JSON: Final[dict[str, Any]] = {**TERMS, "lighthouseFee": 7}
DEMAND_5_JSON: Final[dict[str, Any]] = {**DEMAND_JSON, "nonce": 3, "sender": SENDER}
RESULT_JSON: Final[dict[str, Any]] = {
    "liability": LIGHTHOUSE,
    "result": MODEL,
    "success": True,
    "signature": SIGNATURE,
}
WITHDRAWAL_JSON: Final[dict[str, Any]] = {
    "withdraws": NONCE,
    "lighthouse": LIGHTHOUSE,
    "deadline": 44058,
    "signature": SIGNATURE,
}
FEEDBACK_JSON: Final[dict[str, Any]] = {"order": NONCE, "accepted": 1, "signature": SIGNATURE}
TRANSACTION_JSON: Final[dict[str, Any]] = {"tx": NONCE}


def payload(fields: dict[str, Any], **changes: Any) -> bytes:
    """The JSON of `fields` with some changed; those changed to `...` are left out."""
    changed = {name: value for name, value in {**fields, **changes}.items() if value is not ...}
    return json.dumps(changed).encode()
