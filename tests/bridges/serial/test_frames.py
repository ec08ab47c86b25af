"""The codec of our own frames."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridges.serial.dialect import LineCounters
from bridges.serial.frames import MAX_PAYLOAD, Frame, FrameDecoder, FrameKind, crc16, decode_frame, encode_frame

frames = st.builds(
    Frame, st.sampled_from(FrameKind), st.integers(0, 15), st.integers(0, 255), st.binary(max_size=MAX_PAYLOAD)
)


def test_the_checksum_is_crc_16_ccitt_false() -> None:
    assert crc16(b"123456789") == 0x29B1


def test_a_frame_is_encoded_as_in_its_specification() -> None:
    assert encode_frame(Frame(FrameKind.CALL, 1, 0, b"\xa3red")).hex(" ") == "02 31 07 a3 72 65 64 03 7b 00"


@given(st.lists(frames, max_size=5), st.integers(1, 40))
def test_frames_are_found_again_in_pieces_of_any_size(sent: list[Frame], size: int) -> None:
    line = b"".join(map(encode_frame, sent))
    decoder = FrameDecoder(LineCounters())
    found = [frame for start in range(0, len(line), size) for frame in decoder.feed(line[start : start + size])]
    assert found == sent


@given(frames, st.integers(0, 10_000), st.integers(1, 255))
def test_no_single_damaged_byte_passes(frame: Frame, place: int, difference: int) -> None:
    line = bytearray(encode_frame(frame))
    line[place % (len(line) - 1)] ^= difference
    assert frame not in FrameDecoder(LineCounters()).feed(bytes(line))
    assert decode_frame(bytes(line[:-1])) is None or 0 in line[:-1]


@given(st.binary(max_size=600), frames)
def test_the_frame_after_noise_and_its_end_is_found(noise: bytes, frame: Frame) -> None:
    counters = LineCounters()
    assert FrameDecoder(counters).feed(noise + b"\0" + encode_frame(frame))[-1] == frame


def test_damaged_frames_are_counted() -> None:
    counters = LineCounters()
    line = bytearray(encode_frame(Frame(FrameKind.EVENT, 0, 1, b"abc")))
    line[3] ^= 1
    assert FrameDecoder(counters).feed(bytes(line)) == []
    assert (counters.damaged, counters.received) == (1, 0)


def test_a_payload_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="97 bytes"):
        encode_frame(Frame(FrameKind.CALL, 0, 0, bytes(97)))


def test_noise_without_an_end_costs_no_memory() -> None:
    counters = LineCounters()
    decoder = FrameDecoder(counters)
    for _ in range(1000):
        decoder.feed(b"\x55" * 100)
    assert decoder.pending < 1000
    assert counters.noise > 90_000
