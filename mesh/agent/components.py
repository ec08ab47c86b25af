"""The parts of an agent, opened in their order and closed in the reverse one."""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mesh.composition import chain_of, endpoints_of
from mesh.content import Exchange, Store
from mesh.errors import ConfigurationError
from mesh.network import Channel, Network, Services
from mesh.work.ledger import Ledger
from mesh.work.outbox import Outbox
from mesh.work.workshop import Workshop

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.chain import Account, Chain
    from mesh.settings import Settings
    from schemas import Signer


class ChainHead:
    """The chain's time as this agent knows it: the number of the last block handled, and when that was."""

    def __init__(self, head: int) -> None:
        self.pass_to(head)

    def pass_to(self, block: int) -> None:
        """All of `block` has been handled."""
        self.head = block
        self.passed_at = time.monotonic()


@dataclass(frozen=True, kw_only=True)
class AgentComponents:
    """What an agent that trades and works consists of; all of it is open."""

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
    clock: ChainHead
    directory: Path
    """Where what concerns this chain is kept: ledger and recordings."""

    def workshop(self) -> Workshop:
        """The parts that the executor works with."""
        recordings = self.directory / "recordings"
        try:
            recordings.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"can't keep recordings in {recordings}: {error.strerror}", hint="give another folder with --data-dir"
            ) from None
        return Workshop(
            session=self.network.session,
            signer=self.signer,
            ledger=self.ledger,
            outbox=self.outbox,
            store=self.store,
            exchange=self.exchange,
            settings=self.settings,
            recordings=recordings,
        )


@asynccontextmanager
async def watching(settings: Settings) -> AsyncIterator[tuple[Network, Channel]]:
    """The parts of an agent that only watches the market: it needs a router, no account and no chain."""
    async with (
        Network(endpoints_of(settings)) as network,
        Channel(network.session, settings.lighthouse_contract) as channel,
    ):
        yield network, channel


@asynccontextmanager
async def working(settings: Settings, account: Account, chain: Chain | None) -> AsyncIterator[AgentComponents]:
    """The parts of an agent with an account, on `chain` (open), or on the chain that the settings name.

    Its state is in the settings' folder, by address; what concerns the chain, by chain.
    """
    async with AsyncExitStack() as stack:
        if chain is None:
            chain = await stack.enter_async_context(chain_of(settings, account))
        home = settings.state_directory / account.address
        directory = home / await _name_of(chain)
        clock = ChainHead(await chain.block_number())
        network = await stack.enter_async_context(Network(endpoints_of(settings)))
        channel = await stack.enter_async_context(
            await _channel_of(settings.lighthouse_contract, network, chain=chain, clock=clock)
        )
        ledger = await stack.enter_async_context(Ledger(directory / "ledger.sqlite"))
        store = await asyncio.to_thread(
            Store, home / "content", limit=settings.objective_expanded_limit, quota=settings.content_limit
        )
        stack.callback(store.close)
        yield AgentComponents(
            settings=settings,
            network=network,
            chain=chain,
            channel=channel,
            signer=account.signer,
            ledger=ledger,
            outbox=Outbox(ledger, channel, network, head=lambda: clock.head),
            store=store,
            exchange=await stack.enter_async_context(Exchange(network.session, store)),
            services=await stack.enter_async_context(Services(network.session, account.address)),
            clock=clock,
            directory=directory,
        )


async def _channel_of(lighthouse: str, network: Network, *, chain: Chain, clock: ChainHead) -> Channel:
    """The channel of a lighthouse, not yet open, with names and blocks as the chain has them."""
    address = await chain.names.address(lighthouse)
    return Channel(network.session, lighthouse, address=address, resolver=chain.names.address, head=lambda: clock.head)


async def _name_of(chain: Chain) -> str:
    """What tells this chain from all others: a development chain that is started anew has the number of the old one,
    and the same addresses for other contracts."""
    block_hash = await chain.node.block_hash(min(1, await chain.block_number()))
    return f"{chain.chain_id}-{block_hash.hex()[:8]}"
