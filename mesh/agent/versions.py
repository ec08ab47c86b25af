"""The versions of our orders of generation 5: each was signed again when another order had used its nonce.

They differ in their nonce only. A reorganisation may free the nonce of an earlier version, which then may become the
contract that its maker waits for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from schemas import Demand, message_hash

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.agent.orders import TradedOrder
    from schemas import Liability

EARLIER: Final = 16
"""Nonces before an order's that an earlier version of it may have."""


def earlier_version(orders: Iterable[TradedOrder], liability: Liability, digest: str) -> TradedOrder | None:
    """The demand among `orders` that had the hash `digest` before it was signed again, of a liability's demand."""
    for order in orders:
        signed, nonce = order.signed, order.nonce
        is_alike = (signed.objective, signed.cost) == (liability.objective, liability.cost)
        if isinstance(signed, Demand) and nonce is not None and is_alike:
            for earlier in range(max(0, nonce - EARLIER), nonce):
                if message_hash(replace(signed, nonce=earlier)).hex() == digest:
                    return order
    return None
