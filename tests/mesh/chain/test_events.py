"""Decoding logs."""

from __future__ import annotations

import pytest

from mesh.chain import NewLighthouse
from mesh.chain.answers import Address, Count, Data, Log, Word
from mesh.chain.following import decode_log
from schemas import keccak256
from schemas.address import address_bytes

LIGHTHOUSE = "0x5FbDB2315678afecb367f032d93F642f64180aa3"
FACTORY = "0x" + "12" * 20
NAME = b"airalab"


def _log(name: bytes, *, announced: int) -> Log:
    """A factory's NewLighthouse, with a name whose length is stated as `announced` bytes."""
    return Log(
        address=Address(FACTORY),
        topics=[Word(keccak256(b"NewLighthouse(address,string)")), Word(address_bytes(LIGHTHOUSE).rjust(32, b"\0"))],
        data=Data((32).to_bytes(32, "big") + announced.to_bytes(32, "big") + name),
        block_number=Count(1),
        block_hash=Word(bytes(32)),
        transaction_hash=Word(bytes(32)),
        log_index=Count(0),
    )


@pytest.mark.parametrize("padding", [0, 32 - len(NAME), 5])
def test_padded_and_unpadded_lighthouse_names_are_decoded(padding: int) -> None:
    """The original factory of generation 3 cuts the event's data off where the name ends."""
    log = _log(NAME + bytes(padding), announced=len(NAME))
    assert decode_log(log) == NewLighthouse(LIGHTHOUSE, "airalab", "0x" + "00" * 32)


def test_a_name_that_fills_its_words_is_decoded() -> None:
    event = decode_log(_log(b"a" * 64, announced=64))
    assert isinstance(event, NewLighthouse)
    assert event.name == "a" * 64


@pytest.mark.parametrize("name", [b"", NAME, b"\xff" * 70])
def test_a_log_with_a_missing_or_invalid_name_is_not_an_event(name: bytes) -> None:
    assert decode_log(_log(name, announced=70)) is None
