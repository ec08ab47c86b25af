"""Message validators of tests, and what they make of messages."""

from __future__ import annotations

from typing import Any

from mesh.network import MarketRules, MessageValidator, message_key
from mesh.network._validation import Unresolved
from schemas import Demand, SignedMessage, Verified, encode
from tests.support.orders import LIGHTHOUSE, MARKET

HEAD = 100
NAME = "xrt.3.robonomics.eth"


def validator(kind: type[Any] = Demand, **options: Any) -> MessageValidator[Any]:
    of_rules = {name: options.pop(name) for name in tuple(options) if name not in ("deduplication_limit", "clock")}
    given: dict[str, Any] = {"address": LIGHTHOUSE, "head": lambda: HEAD} | of_rules
    return MessageValidator(kind, MarketRules(MARKET, **given), **options)


def counted(checked: MessageValidator[Any]) -> dict[str, int]:
    return dict(checked.statistics(received=0, dropped=0).invalid)


def check_payload(checked: MessageValidator[Any], key: str, payload: bytes) -> Verified[Any] | Unresolved[Any] | None:
    """What becomes of a payload that is received alone."""
    return next((found for some in checked.check_all([(key, payload)]) for found in some), None)


def check(checked: MessageValidator[Any], message: SignedMessage, key: str | None = None) -> Verified[Any] | None:
    accepted = check_payload(checked, key or message_key(MARKET, message), encode(message))
    assert not isinstance(accepted, Unresolved)
    return accepted
