"""Fixtures for the tests of logs, metrics and health."""

from __future__ import annotations
