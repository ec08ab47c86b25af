"""The components of an agent, and in what order they are opened."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.blocklist import blocklist_at
from mesh.composition import chain_of, endpoints_of, state_folder
from mesh.content import Exchange, Store
from mesh.errors import ConfigurationError
from mesh.network import Channel, Network, Services
from mesh.outage_log import OutageLog
from mesh.private_files import make_private_folder
from mesh.work.ledger import Ledger
from mesh.work.outbox import RESEND, Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.chain import Account, Chain
    from mesh.flood import Drops
    from mesh.retry import RetryPolicy
    from mesh.settings import Settings
    from schemas import Signer


log = logging.getLogger(__name__)

LEDGER: Final = "ledger.sqlite"
"""The name of the ledger in an account's folder for a chain."""


class ChainHead:
    """How far this agent has handled the chain: the number of its last block, and when that was."""

    def __init__(self, head: int) -> None:
        self._advanced = asyncio.Event()
        self.head = head
        self.advance_to(head)
        self._handled = -1

    def begin_after(self, block: int) -> None:
        """All blocks up to `block` were handled in earlier runs, or are older than this agent."""
        self._handled = block
        self.head = max(self.head, block)
        self._advance()

    def advance_to(self, block: int) -> None:
        """All of `block` has been handled."""
        self.head = self._handled = block
        self.advanced_at = time.monotonic()
        self._advance()

    async def reached(self, block: int) -> None:
        """Return when `block` has been handled."""
        while self._handled < block:
            await self._advanced.wait()

    def _advance(self) -> None:
        self._advanced.set()
        self._advanced = asyncio.Event()


@dataclass(frozen=True, kw_only=True)
class AgentComponents:
    """The open components of an agent with an account."""

    settings: Settings
    network: Network
    chain: Chain
    channel: Channel
    signer: Signer
    ledger: Ledger
    outbox: Outbox
    store: Store
    exchange: Exchange
    services: Services
    chain_head: ChainHead
    outages: OutageLog
    """Outages of the node, for everything that waits for it."""
    drops: Drops
    """What was dropped because of floods."""
    directory: Path
    """The folder of what belongs to this chain: the ledger and unfinished recordings."""

    @property
    def recordings(self) -> Path:
        """The folder of unfinished recordings; finished ones are in the store."""
        return self.directory / "recordings"


@asynccontextmanager
async def watching(settings: Settings, *, drops: Drops | None = None) -> AsyncIterator[tuple[Network, Channel]]:
    """The components of an agent that only watches the market: it needs a router, but no account and no chain."""
    async with (
        Network(endpoints_of(settings)) as network,
        Channel(
            network.session, settings.lighthouse_contract, drops=drops, answer_timeout=settings.answer_timeout
        ) as channel,
    ):
        yield network, channel


@asynccontextmanager
async def working(
    settings: Settings, account: Account, chain: Chain | None, *, drops: Drops, resend: RetryPolicy = RESEND
) -> AsyncIterator[AgentComponents]:
    """The components of an agent with an account, on `chain` (open), or on the chain that the settings name."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        if chain is None:
            chain = await enter(chain_of(settings, account))
        directory = await state_folder(settings, chain, account.address)
        ledger = await enter(Ledger(directory / LEDGER, reorg_depth=chain.node.timing.reorg_depth))
        chain_head = ChainHead(await _handled(ledger, chain))
        network, channel = await enter(connected(settings, chain, chain_head, drops))
        store = await asyncio.to_thread(
            Store, directory.parent / "content", limit=settings.objective_expanded_limit, quota=settings.content_limit
        )
        stack.callback(store.close)
        parts = AgentComponents(
            settings=settings,
            network=network,
            chain=chain,
            channel=channel,
            signer=account.signer,
            ledger=ledger,
            outbox=Outbox(ledger, channel, network, head=lambda: chain_head.head, policy=resend),
            store=store,
            exchange=await enter(Exchange(network.session, store, address=account.address.lower(), drops=drops)),
            services=await enter(Services(network.session, account.address, drops=drops)),
            chain_head=chain_head,
            outages=OutageLog(log, "chain"),
            drops=drops,
            directory=directory,
        )
        _make_folder(parts.recordings)
        yield parts


async def _handled(ledger: Ledger, chain: Chain) -> int:
    """The last block that an agent has handled. Later ones may have made contracts of its orders, also of expired ones.

    A new agent begins at the head, and remembers that block before it posts an order: if it is replaced, the order can
    become a contract in an earlier one. Raises `ChainWentBack` if the chain lacks blocks that were handled, and more
    than it may replace.
    """
    from mesh.chain import ChainWentBack

    (handled, _), head = await ledger.cursor(), await chain.block_number()
    if handled is None:
        await ledger.set_cursor(head, history=(await chain.history_at(head)).encode())
        return head
    if handled > head + chain.node.timing.reorg_depth:
        raise ChainWentBack(handled + 1, head)
    return handled


@asynccontextmanager
async def connected(
    settings: Settings, chain: Chain, head: ChainHead, drops: Drops
) -> AsyncIterator[tuple[Network, Channel]]:
    """A session, and the channel of the lighthouse, which resolves names and knows the head by the chain."""
    async with (
        Network(endpoints_of(settings)) as network,
        Channel(
            network.session,
            settings.lighthouse_contract,
            address=await chain.names.address(settings.lighthouse_contract),
            resolver=chain.names.address,
            validators=chain.validators,
            head=lambda: head.head,
            blocked=blocklist_at(settings.blocked_signers),
            drops=drops,
            answer_timeout=settings.answer_timeout,
        ) as channel,
    ):
        yield network, channel


def _make_folder(folder: Path) -> None:
    try:
        make_private_folder(folder)
    except OSError as error:
        raise ConfigurationError(
            f"can't keep recordings in {folder}: {error.strerror}", hint="give another folder with --data-dir"
        ) from None
