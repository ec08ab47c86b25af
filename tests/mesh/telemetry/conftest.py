"""Fixtures for the tests of what an operator sees."""

from __future__ import annotations

from tests.support.market import founded, place

__all__ = ["founded", "place"]
