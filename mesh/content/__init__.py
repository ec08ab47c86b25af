"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content.assembly import Assembly
from mesh.content.dag import Place
from mesh.content.errors import (
    ContentCorrupt,
    ContentPinned,
    ContentTooLarge,
    ContentUnavailable,
    QuotaReached,
    StoreDamaged,
    StoreFull,
)
from mesh.content.exchange import Exchange, ExchangeStatistics
from mesh.content.holdings import Check, Collected, Entry, Progress, Usage
from mesh.content.store import Store

__all__ = [
    "Assembly",
    "Check",
    "Collected",
    "ContentCorrupt",
    "ContentPinned",
    "ContentTooLarge",
    "ContentUnavailable",
    "Entry",
    "Exchange",
    "ExchangeStatistics",
    "Place",
    "Progress",
    "QuotaReached",
    "Store",
    "StoreDamaged",
    "StoreFull",
    "Usage",
]
