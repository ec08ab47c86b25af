"""Where in a market a message belongs: its key, from its content."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from schemas import Demand, Offer, Result, SignedMessage, Verified, message_hash

if TYPE_CHECKING:
    from schemas.keys import MarketKind

KINDS: Final[dict[type[Any], MarketKind]] = {kind: kind.kind for kind in (Demand, Offer, Result)}
"""What each message is called in keys."""


def message_key(lighthouse: str, message: SignedMessage) -> str:
    """The key on which `message` belongs at `lighthouse` (ENS name, lower case)."""
    return key_of(lighthouse, message, message_hash(message))


def verified_key(lighthouse: str, verified: Verified[Any]) -> str:
    """As `message_key`, for a message whose hash is known."""
    return key_of(lighthouse, verified.message, verified.hash)


def key_of(lighthouse: str, message: SignedMessage, digest: bytes) -> str:
    """As `message_key`, given the message's hash. Its fields were checked when it was made, so they are not again."""
    return f"aira/{lighthouse}/{message.kind}/{message.key_chunk}/{digest.hex()}"
