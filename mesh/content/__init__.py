"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content.assembly import Assembly
from mesh.content.dag import Place
from mesh.content.errors import ContentCorrupt, ContentTooLarge, ContentUnavailable, StoreFull
from mesh.content.exchange import Exchange, ExchangeStatistics
from mesh.content.store import Store

__all__ = [
    "Assembly",
    "ContentCorrupt",
    "ContentTooLarge",
    "ContentUnavailable",
    "Exchange",
    "ExchangeStatistics",
    "Place",
    "Store",
    "StoreFull",
]
