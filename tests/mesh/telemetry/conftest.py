"""Fixtures for the tests of logs, metrics and health."""

from __future__ import annotations

from tests.support.market import founded, place

__all__ = ["founded", "place"]
