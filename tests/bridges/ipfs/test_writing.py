from __future__ import annotations

import json
from pathlib import Path

import pytest

from bridges.ipfs.writing import legacy_json
from schemas import InvalidMessage, OrderFeedback, TransactionFeedback, decode
from tests.support.orders import demand

VECTORS = Path(__file__).parents[2] / "schemas" / "vectors"
WIRES = [
    vector["wire"]
    for generation in (3, 5)
    for vector in json.loads((VECTORS / f"messages-generation-{generation}.json").read_text())
]


@pytest.mark.parametrize("wire", WIRES)
def test_a_message_is_written_byte_for_byte_as_the_legacy_clients_wrote_it(wire: str) -> None:
    assert legacy_json(decode(wire.encode())).decode() == wire


def test_feedback_is_written_with_its_fields_in_their_documented_order() -> None:
    order = OrderFeedback(order="ab" * 32, accepted=1, signature="cd" * 65)
    assert legacy_json(order).decode() == f'{{"order":"{"ab" * 32}","accepted":1,"signature":"{"cd" * 65}"}}'
    assert legacy_json(TransactionFeedback(tx="ab" * 32)).decode() == f'{{"tx":"{"ab" * 32}"}}'


def test_an_unsigned_message_is_not_written() -> None:
    from msgspec.structs import replace

    with pytest.raises(InvalidMessage, match="not signed"):
        legacy_json(replace(demand(), signature=""))
