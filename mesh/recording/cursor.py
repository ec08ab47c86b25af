"""Reading fields off bytes of unknown origin: nothing is read past their end."""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING, Final

from mesh.recording.errors import CorruptRecording

if TYPE_CHECKING:
    from pathlib import Path

_U16: Final = Struct("<H")
_U32: Final = Struct("<I")
_U64: Final = Struct("<Q")


class Cursor:
    """A position in some bytes; every call takes what is next. Little-endian, as MCAP and bags are.

    All calls raise `CorruptRecording` (of `path`) when the bytes end before.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self._path = path
        self._data = data
        self._position = 0

    @property
    def left(self) -> int:
        """Bytes that are left."""
        return len(self._data) - self._position

    def take(self, length: int) -> bytes:
        """The next `length` bytes."""
        if length > self.left:
            raise CorruptRecording(self._path, f"a field of {length} bytes where {self.left} are left")
        taken = self._data[self._position : self._position + length]
        self._position += length
        return taken

    def u16(self) -> int:
        """The next two bytes as a number."""
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        """The next four bytes as a number."""
        return int(_U32.unpack(self.take(4))[0])

    def u64(self) -> int:
        """The next eight bytes as a number."""
        return int(_U64.unpack(self.take(8))[0])

    def data(self) -> bytes:
        """Bytes that follow their length of four bytes."""
        return self.take(self.u32())

    def text(self) -> str:
        """A text in UTF-8 that follows its length of four bytes."""
        return text_of(self._path, self.data())

    def pairs(self) -> dict[str, str]:
        """A map of texts that follows its length of four bytes."""
        inner = Cursor(self._path, self.data())
        found = {}
        while inner.left:
            key = inner.text()
            found[key] = inner.text()
        return found


def text_of(path: Path, data: bytes) -> str:
    """`data` as UTF-8. Raises `CorruptRecording`."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise CorruptRecording(path, f"{data[:40]!r} is not text") from None
