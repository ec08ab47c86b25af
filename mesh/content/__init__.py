"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content.assembly import Assembly
from mesh.content.dag import BlockRef, is_block
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
from mesh.content.exchange import Exchange, session_address
from mesh.content.files import Progress
from mesh.content.store import Store
