from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bridges.ipfs.lines import lines_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

TEXT = b"one\n\ntwo two\nthree"


async def pieces(data: bytes, size: int) -> AsyncIterator[bytes]:
    for start in range(0, len(data), size):
        yield data[start : start + size]


@pytest.mark.parametrize("size", range(1, len(TEXT) + 1))
async def test_lines_do_not_depend_on_how_the_stream_is_cut(size: int) -> None:
    assert [line async for line in lines_of(pieces(TEXT, size), limit=100)] == [b"one", b"", b"two two"]


@pytest.mark.parametrize("size", range(1, len(TEXT) + 1))
async def test_a_line_that_is_too_long_comes_empty_and_the_next_one_whole(size: int) -> None:
    assert [line async for line in lines_of(pieces(b"123456\n12345\n1234567\nend\n", size), limit=5)] == [
        b"",
        b"12345",
        b"",
        b"end",
    ]
