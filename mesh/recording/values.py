"""The numbers in recorded messages, to plot them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from schemas.errors import InvalidPayload
from schemas.payloads import String, decode_value

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.recording.objective import Played

LONGEST_LIST: Final = 12
"""Members of a list whose numbers are read."""


def numbers_of(message: Played) -> Iterator[tuple[str, float]]:
    """The numbers in a message with the paths of their fields: `.linear.x`, empty for a number alone.

    A std_msgs/String may consist of numbers, too. Of a message that is not of its type there are none.
    """
    try:
        value = decode_value(message.payload, message.type)
    except InvalidPayload:
        return
    if isinstance(value, String):
        try:
            value = [float(word) for word in value.data.split(maxsplit=LONGEST_LIST)[:LONGEST_LIST]]
        except ValueError:
            return
        value = value[0] if len(value) == 1 else value
    yield from _numbers_in(value, "")


def _numbers_in(value: Any, name: str) -> Iterator[tuple[str, float]]:
    match value:
        case bool() | int() | float():
            try:
                yield name, float(value)
            except OverflowError:
                return
        case dict():
            for key, member in value.items():
                yield from _numbers_in(member, f"{name}.{key}")
        case list():
            for number, member in enumerate(value[:LONGEST_LIST]):
                yield from _numbers_in(member, f"{name}[{number}]")
