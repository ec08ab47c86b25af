"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content.assembly import Assembly, is_block
from mesh.content.dag import BlockRef
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
from mesh.content.holdings import EvictionReport, IntegrityReport, Progress, StoreEntry, Usage
from mesh.content.store import Store

__all__ = [
    "Assembly",
    "BlockRef",
    "ContentCorrupt",
    "ContentPinned",
    "ContentTooLarge",
    "ContentUnavailable",
    "EvictionReport",
    "Exchange",
    "ExchangeStatistics",
    "IntegrityReport",
    "Progress",
    "QuotaReached",
    "Store",
    "StoreDamaged",
    "StoreEntry",
    "StoreFull",
    "Usage",
    "is_block",
]
