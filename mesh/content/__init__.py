"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content.assembly import Assembly
from mesh.content.dag import BlockRef, is_block
from mesh.content.directory import StoreEntry, Usage
from mesh.content.download import DownloadTiming
from mesh.content.errors import (
    ContentCorrupt,
    ContentPinned,
    ContentTooLarge,
    ContentUnavailable,
    QuotaReached,
    StoreDamaged,
    StoreFull,
)
from mesh.content.exchange import Exchange, ExchangeStatistics, session_address
from mesh.content.files import Progress
from mesh.content.quota import EvictionReport
from mesh.content.store import IntegrityReport, Store

__all__ = [
    "Assembly",
    "BlockRef",
    "ContentCorrupt",
    "ContentPinned",
    "ContentTooLarge",
    "ContentUnavailable",
    "DownloadTiming",
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
    "session_address",
]
