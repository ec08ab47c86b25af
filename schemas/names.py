"""ENS names in messages: which there are, and putting addresses in their places.

A message is hashed with addresses only. Asking a chain for them is not done here: collect the names with `names_in`,
resolve them, and hand them to `resolve_names`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from msgspec.structs import replace

from schemas.address import parse_address
from schemas.errors import InvalidMessage
from schemas.messages import Demand, Message, Offer, Result

if TYPE_CHECKING:
    from collections.abc import Mapping

_AnyMessage = TypeVar("_AnyMessage", bound=Message)

_NONE: Final[frozenset[str]] = frozenset()


def names_in(message: Message) -> frozenset[str]:
    """The ENS names that stand in the address fields of a message, in lower case."""
    # Every ENS name has a dot, and no address has; every message passes here.
    names = [text for text in _parties(message) if "." in text]
    return frozenset(names) if names else _NONE


def resolve_names(message: _AnyMessage, addresses: Mapping[str, str]) -> _AnyMessage:
    """The message with the address of every ENS name in its place; `addresses` maps lower-case names to addresses.

    Raises `InvalidMessage` (`unresolved-name`) if a name is missing, `InvalidAddress` if it maps to no address.
    """
    names = names_in(message)
    if not names:
        return message
    if missing := names - addresses.keys():
        raise InvalidMessage("unresolved-name", f"no address is known for {', '.join(sorted(missing))}")
    texts = {field: getattr(message, field) for field in message.__struct_fields__}
    return replace(message, **{field: parse_address(addresses[text]) for field, text in texts.items() if text in names})


def _parties(message: Message) -> tuple[str, ...]:
    if isinstance(message, (Demand, Offer)):
        return (message.token, message.lighthouse, message.validator, message.sender or "")
    return (message.liability,) if isinstance(message, Result) else ()
