"""Markets for the tests of this folder."""

from __future__ import annotations

from tests.support.market import founded, place

__all__ = ["founded", "place"]
