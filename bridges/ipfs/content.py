"""Content over the bridge: the mesh has what IPFS has, and what is made in the mesh is added to IPFS."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from bridges.ipfs.adding import add_as_named
from bridges.ipfs.errors import IpfsError
from mesh.content import ContentUnavailable
from mesh.content.download import HOLDER
from mesh.content.exchange import CID_SELECTOR
from mesh.errors import AiraError, ClosedError, InvalidKey
from mesh.network import call_in_loop
from schemas import CidKey, InputError, parse_block, parse_key
from schemas.status import ContentMetrics

if TYPE_CHECKING:
    from collections.abc import Coroutine
    from pathlib import Path
    from types import TracebackType

    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.sources import Sources
    from mesh.content import Exchange, Store

log = logging.getLogger(__name__)

PATIENCE: Final = 10.0
"""Seconds that a source has for a block."""
ANSWERS: Final = 32
"""Questions of the mesh that are passed on to IPFS at once; others get no answer from here, and are asked again."""
TRANSFERS: Final = 8
"""Files on their way at once because a message names them; the others wait."""
WAITING: Final = 4096
"""Files that wait for that; more are passed over, and count as failed."""
ATTEMPTS: Final = 4
"""How often a file that a message names is tried to be added."""
AGAIN: Final = 10.0
"""Seconds between two of these attempts."""
FRUITLESS: Final = 10.0
"""Seconds for which a block that IPFS did not give is not asked for again."""
REMEMBERED: Final = 65_536
"""Blocks of which it is remembered that they are parts, or that IPFS did not give them."""


class ContentBridge:
    """Gives the mesh what IPFS has, and IPFS what the mesh has: `async with ContentBridge(...) as content`.

    Inside, a block that somebody in the mesh asks for and that `store` does not hold is asked of `sources`, and the
    file that it begins is kept. `daemon` is where files are added; `providers` are further nodes that pin them.
    `size_limit` is in bytes of a file, `timeout` in seconds for a file, `again` in seconds between two attempts to add
    one. What is used stays the caller's to close.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        exchange: Exchange,
        sources: Sources,
        daemon: Daemon,
        *,
        providers: tuple[Daemon, ...] = (),
        size_limit: int,
        timeout: float,
        again: float = AGAIN,
    ) -> None:
        self._session = session
        self._id = str(session.zid())
        self._store = store
        self._exchange = exchange
        self._sources = sources
        self._daemon = daemon
        self._providers = providers
        self._size_limit = size_limit
        self._timeout = timeout
        self._again = again
        self._parts: OrderedDict[str, None] = OrderedDict()
        self._fruitless: OrderedDict[str, float] = OrderedDict()
        self._tasks: set[asyncio.Task[None]] = set()
        self._under_way: dict[str, asyncio.Task[Path]] = {}
        self._answering = 0
        self._transfers = asyncio.Semaphore(TRANSFERS)
        self._adding: set[str] = set()
        self._open = False
        self._counts = Counter[str]()

    async def __aenter__(self) -> Self:
        if self._open:
            raise ClosedError("this content bridge is open already")
        self._open = True
        loop = asyncio.get_running_loop()
        self._queryable: Any = self._session.declare_queryable(
            CID_SELECTOR, lambda query: call_in_loop(loop, self._answer_soon, query)
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        if not self._session.is_closed():
            self._queryable.undeclare()
        tasks = [*self._tasks, *self._under_way.values()]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def fetch(self, cid: str) -> Path:
        """Where the file is in the store, from IPFS if it is not held. Asked for twice at once, it is fetched once.

        Raises what `Sources.fetch` does.
        """
        under_way = self._under_way.get(cid)
        if under_way is None:
            under_way = asyncio.create_task(self._fetch(cid), name=f"fetch {cid} from IPFS")
            self._under_way[cid] = under_way
            under_way.add_done_callback(lambda _: self._under_way.pop(cid, None))
        return await asyncio.shield(under_way)

    async def add(self, cid: str) -> None:
        """Have the file, which the mesh has, added to IPFS under the same name, and pinned by the providers.

        Raises a `ContentError` when the mesh does not give it, `IpfsError` when the daemon does not take it.
        """
        self._adding.add(cid)  # it is the mesh that is asked now
        try:
            path = await self._exchange.fetch(cid, size_limit=self._size_limit, timeout=self._timeout)
        finally:
            self._adding.discard(cid)
        try:
            size = (await asyncio.to_thread(path.stat)).st_size
            as_file = await add_as_named(self._daemon, self._store, path, cid, timeout=self._timeout)
        except OSError as error:  # the store had to make room meanwhile
            raise ContentUnavailable(cid, f"it can't be read: {error.strerror}") from error
        self._counts.update(added=1, added_bytes=size, by_blocks=0 if as_file else 1)
        for provider in self._providers:
            try:
                await provider.pin(cid, timeout=self._timeout)
                self._counts["pinned"] += 1
            except IpfsError as error:
                log.warning("%s is not pinned: %s", cid, error)

    def fetch_soon(self, cid: str) -> None:
        """As `fetch`, without waiting; what fails is logged and counted."""
        self._start(self._try_to_fetch(cid), f"fetch {cid}")

    def add_soon(self, cid: str) -> None:
        """As `add`, without waiting; what is not there or not taken is tried again, what fails logged and counted."""
        self._start(self._try_to_add(cid), f"add {cid}")

    def figures(self) -> ContentMetrics:
        """What was done so far."""
        counts = self._counts
        return ContentMetrics(
            fetched=counts["fetched"],
            fetched_bytes=self._sources.bytes,
            lies=self._sources.lies.total(),
            answered=counts["answered"],
            added=counts["added"],
            added_bytes=counts["added_bytes"],
            by_blocks=counts["by_blocks"],
            pinned=counts["pinned"],
            failed=counts["failed"],
        )

    async def _fetch(self, cid: str) -> Path:
        path = await self._sources.fetch(
            self._store, cid, size_limit=self._size_limit, timeout=self._timeout, patience=PATIENCE
        )
        self._counts["fetched"] += 1
        return path

    async def _try_to_fetch(self, cid: str) -> None:
        try:
            async with self._transfers:
                await self.fetch(cid)
        except AiraError as error:
            self._counts["failed"] += 1
            log.info("not fetched from IPFS: %s", error)

    async def _try_to_add(self, cid: str) -> None:
        for left in reversed(range(ATTEMPTS)):
            try:
                async with self._transfers:
                    await self.add(cid)
                return
            except AiraError as error:
                if not left or not isinstance(error, ContentUnavailable | IpfsError):
                    self._counts["failed"] += 1
                    log.warning("not added to IPFS: %s", error)
                    return
                log.debug("not added to IPFS yet: %s", error)
            await asyncio.sleep(self._again)

    def _start(self, work: Coroutine[Any, Any, None], name: str) -> None:
        if not self._open or len(self._tasks) >= WAITING:
            self._counts["failed"] += 1
            log.debug("too much at once: no %s", name)
            work.close()
            return
        task = asyncio.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _answer_soon(self, query: zenoh.Query) -> None:
        """Take up a question, if it is one for a block and there is room for it."""
        cid = _asked_for(query)
        mine = str(query.parameters.get(HOLDER, self._id)) == self._id
        busy = self._answering >= ANSWERS or len(self._tasks) >= WAITING
        if not self._open or cid is None or not mine or busy or cid in self._adding or self._is_fruitless(cid):
            query.drop()  # type: ignore[no-untyped-call]
            return
        self._answering += 1
        self._start(self._answer(query, cid), f"answer {cid}")

    async def _answer(self, query: zenoh.Query, cid: str) -> None:
        try:
            with query:
                if await asyncio.to_thread(self._store.get_block, cid) is not None:
                    return  # the exchange answers
                try:
                    block = await self._sources.block(cid, timeout=PATIENCE)
                except ContentUnavailable as error:
                    log.debug("%s", error)
                    _remember(self._fruitless, cid, asyncio.get_running_loop().time())
                    return
                query.reply(query.key_expr, block, encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM)
                self._counts["answered"] += 1
            self._keep(cid, block)
        finally:
            self._answering -= 1

    def _keep(self, cid: str, block: bytes) -> None:
        """Fetch all of the file whose first block was asked for."""
        try:
            links = parse_block(block).links
        except InputError:
            return
        for link in links:
            _remember(self._parts, link.cid, None)
        if cid not in self._parts:
            self.fetch_soon(cid)

    def _is_fruitless(self, cid: str) -> bool:
        asked = self._fruitless.get(cid)
        return asked is not None and asyncio.get_running_loop().time() - asked < FRUITLESS


def _asked_for(query: zenoh.Query) -> str | None:
    """The one block that a query names; None for a wildcard, which nobody is to be answered."""
    try:
        key = parse_key(str(query.key_expr))
    except InvalidKey:
        return None
    return key.cid if isinstance(key, CidKey) else None


def _remember(known: OrderedDict[str, Any], cid: str, value: Any) -> None:
    known.pop(cid, None)
    known[cid] = value
    if len(known) > REMEMBERED:
        known.popitem(last=False)
