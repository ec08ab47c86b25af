"""What a board's topics are called in the mesh: as the board calls them, unless its edge agent is told otherwise."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import InputError
from schemas.key_chunks import topic_chunks

if TYPE_CHECKING:
    from collections.abc import Iterable


class Names:
    """The names in the mesh of a board's topics; `given` are pairs of the board's name and the one in the mesh.

    A name stands for all topics beneath it, too, and `/` for all there are: `("/", "/left")` has `/led` be
    `/left/led`. Of several that fit, the longest counts. Raises `InvalidKey` for what is no topic, and `InputError` for
    one that is given twice.
    """

    def __init__(self, given: Iterable[tuple[str, str]] = ()) -> None:
        self._given: dict[str, str] = {}
        for name, other in given:
            before = _beginning(name)
            if before in self._given:
                raise InputError(f"{name} is given two names")
            self._given[before] = _beginning(other)

    def of(self, name: str) -> str:
        """The name in the mesh of the board's topic `name`."""
        before = name
        while True:
            if before in self._given:
                return self._given[before] + name[len(before) :] or name
            if not before:
                return name
            before = before.rpartition("/")[0]


def _beginning(name: str) -> str:
    """With what the names of a topic and of all beneath it begin; nothing for `/`."""
    return "" if name == "/" else topic_chunks(name)
