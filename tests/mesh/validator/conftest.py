"""Markets for the tests of validators."""

from __future__ import annotations

from tests.support.market import founded, place

__all__ = ["founded", "place"]
