"""A provider's word that it can't use a message."""

from __future__ import annotations

import json

from schemas.rejection import Rejection
from tests.schemas.samples import NONCE, SENDER


def test_rejection_is_read_as_written() -> None:
    rejection = Rejection(order=NONCE, reason="deadline", detail="block 7 has passed", provider=SENDER)
    assert Rejection.decode(rejection.encode()) == rejection
    assert json.loads(rejection.encode()).keys() == {"order", "reason", "detail", "provider"}
