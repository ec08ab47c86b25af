"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content._blocks import BlockRef, ContentCorrupt, is_block
from mesh.content._exchange import DownloadTiming, Exchange, session_address
from mesh.content.files import Progress, StoreFull
from mesh.content.store import Assembly, ContentTooLarge, ContentUnavailable, Store
