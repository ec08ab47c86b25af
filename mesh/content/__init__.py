"""Files by CID: kept in a directory, and exchanged block by block over Zenoh."""

from mesh.content._blocks import BlockRef, is_block
from mesh.content._errors import ContentCorrupt, ContentTooLarge, ContentUnavailable, StoreFull
from mesh.content._exchange import DownloadTiming, Exchange, session_address
from mesh.content.files import Progress
from mesh.content.store import Assembly, Store
