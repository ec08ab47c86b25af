"""Why a provider does not settle an order."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from mesh.errors import ChainError


class Refusal(StrEnum):
    """Why a provider refuses an order, as published to its sender."""

    EXPIRED = "expired"
    """Its deadline has passed."""
    DUPLICATE = "duplicate"
    """It is in the book already."""
    LIGHTHOUSE = "lighthouse"
    """It names another lighthouse."""
    FULL = "full"
    """The book is full; try again later."""
    WITHDRAWN = "withdrawn"
    """Its maker has withdrawn it."""
    REPLACED = "replaced"
    """Its maker has signed it again, or another version of it has become a contract."""
    UNDECIDED = "undecided"
    """A transaction with another version of it may still succeed, after a reorganisation; try again later."""
    BLOCKED = "blocked"
    """Its maker is blocked; this is not published."""


RETRIED: Final = (Refusal.FULL, Refusal.REPLACED, Refusal.UNDECIDED)
"""The refusals of orders that the provider may take later."""


class MatchWithdrawn(ChainError, code="match-withdrawn"):
    """An order of a match was withdrawn or replaced, or its signer blocked, before a transaction was sent."""
