"""Answering, from a thread, whoever asks for a block that this store holds."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final

import zenoh

from mesh.errors import AiraError, InvalidKey
from schemas.keys import CidKey, parse_key

if TYPE_CHECKING:
    from mesh.content.store import Store

log = logging.getLogger(__name__)

CID_SELECTOR: Final = "aira/cid/*"
HOLDER: Final = "holder"
"""Parameter of a query that only the session of that Zenoh id is to answer. Without it all holders do."""

_WAITING: Final = 256
"""Queries that may wait. Beyond them the oldest is dropped: its asker sees an empty answer at once, and asks again."""


class BlockServer:
    """Answers queries on `aira/cid/{cid}` with the bytes of the block; with nothing where it is not held.

    `start` and `stop` may block for a moment; neither closes the session. Reads the disk in a thread of its own.
    """

    def __init__(self, session: zenoh.Session, store: Store) -> None:
        self._session = session
        self._store = store
        self._id = str(session.zid())
        self._queryable: zenoh.Queryable[zenoh.Handler[zenoh.Query]] | None = None
        self._thread = threading.Thread(target=self._serve, name="aira-blocks", daemon=True)
        self.served = 0
        self.missed = 0
        self.ignored = 0

    def start(self) -> None:
        """Declare the queryable and begin to answer."""
        self._queryable = self._session.declare_queryable(CID_SELECTOR, zenoh.handlers.RingChannel(_WAITING))
        self._thread.start()

    def stop(self) -> None:
        """Withdraw the queryable and wait for the answer under way."""
        if self._queryable is not None and not self._session.is_closed():
            self._queryable.undeclare()  # type: ignore[no-untyped-call]
        self._thread.join()

    def _serve(self) -> None:
        assert self._queryable is not None
        for query in self._queryable:
            with query:
                try:
                    self._answer(query)
                except (OSError, AiraError, zenoh.ZError):
                    log.exception("a block could not be given to who asked for it")

    def _answer(self, query: zenoh.Query) -> None:
        key = _asked_for(query)
        if key is None or query.parameters.get(HOLDER, self._id) != self._id:
            self.ignored += 1
            return
        block = self._store.get_block(key.cid)
        if block is None:
            self.missed += 1
            return
        query.reply(query.key_expr, block, encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM)
        self.served += 1


def _asked_for(query: zenoh.Query) -> CidKey | None:
    """The one block that a query names; None for a wildcard, which nobody is to be answered."""
    try:
        key = parse_key(str(query.key_expr))
    except InvalidKey:
        return None
    return key if isinstance(key, CidKey) else None
