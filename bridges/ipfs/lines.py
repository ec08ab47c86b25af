"""Lines out of a stream of bytes, bounded."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterable, AsyncIterator


async def lines_of(chunks: AsyncIterable[bytes], *, limit: int) -> AsyncIterator[bytes]:
    """Each line without its end, as soon as it is whole; one of more than `limit` bytes comes as an empty line.

    What follows the last line end is no line: the stream broke off in it.
    """
    kept, too_long = bytearray(), False
    async for chunk in chunks:
        *ends, rest = chunk.split(b"\n")
        for end in ends:
            too_long = too_long or len(kept) + len(end) > limit
            yield b"" if too_long else bytes(kept) + end
            kept.clear()
            too_long = False
        too_long = too_long or len(kept) + len(rest) > limit
        if too_long:
            kept.clear()
        else:
            kept += rest
