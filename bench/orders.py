"""Signed messages for the benchmarks: as many as asked for, all different, all valid."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING

from schemas import ZERO_ADDRESS, Demand, Signer, cid_of_digest

if TYPE_CHECKING:
    from collections.abc import Iterator

LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"
ADDRESS = "0x" + "11" * 20
TOKEN = "0x" + "22" * 20
MODEL = cid_of_digest(bytes(32))


def unsigned_demands(count: int, *, deadline: int = 2**40, lighthouse: str = ADDRESS) -> Iterator[Demand]:
    """Demands of one model that differ in objective and nonce."""
    for _ in range(count):
        yield Demand(
            model=MODEL,
            objective=cid_of_digest(secrets.token_bytes(32)),
            token=TOKEN,
            cost=1000,
            lighthouse=lighthouse,
            validator=ZERO_ADDRESS,
            validator_fee=0,
            deadline=deadline,
            nonce=secrets.token_hex(32),
        )


def signed_demands(count: int, *, lighthouse: str = ADDRESS) -> list[Demand]:
    """The same, each signed by one of sixteen people."""
    people = [Signer(secrets.token_bytes(32)) for _ in range(16)]
    return [
        people[number % 16].sign(demand) for number, demand in enumerate(unsigned_demands(count, lighthouse=lighthouse))
    ]
