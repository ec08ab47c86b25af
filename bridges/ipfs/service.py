"""The IPFS bridge of one process, as the settings describe it."""

from __future__ import annotations

import asyncio
import logging
import secrets
from typing import TYPE_CHECKING, Final

from bridges.ipfs._channel import BridgeParts, ChannelBridge, bridge_families, health_parts
from bridges.ipfs._content import URGENT, ContentBridge, ContentParts, ContentSources, Gateway, content_families
from bridges.ipfs._relay import RelayJournal, RelayValidator, Side
from bridges.ipfs.daemon import Daemon, authorization_of
from mesh.base.flood import Drops
from mesh.base.fresh_file import blocklist_at
from mesh.base.lifecycle import Role
from mesh.base.log_context import log_event
from mesh.base.outage_log import OutageLog
from mesh.base.retry import REMOTE, Backoff, RetryPolicy
from mesh.content import Exchange
from mesh.errors import ChainError
from mesh.market.store import MarketStore, Withdrawals
from mesh.network import MarketRules
from mesh.role.composition import open_store
from mesh.telemetry.metrics import drop_family
from schemas import Demand, Result, Signer, decode

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping
    from contextlib import AbstractAsyncContextManager, AsyncExitStack
    from pathlib import Path

    from bridges.ipfs._relay import RelayMessage
    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily


log = logging.getLogger(__name__)


class ChainView:
    """What validation needs from the chain: the lighthouses' addresses, ENS names and the latest block.

    `chain` creates an unopened client; `lighthouses` are ENS names, whose `rules` it makes and keeps up to date;
    `interval` is in seconds between two reads of the latest block. Start `run` as a task. Until the node is reached
    nothing is known, which is logged once; what was read stays known.
    """

    def __init__(
        self,
        chain: Callable[[], AbstractAsyncContextManager[Chain]],
        lighthouses: tuple[str, ...],
        *,
        interval: float,
        blocked: Container[str] = frozenset(),
        retry: RetryPolicy = REMOTE,
    ) -> None:
        self._make_chain = chain
        self._interval = interval
        self._retry = retry
        self._outage = OutageLog(log, "chain")
        self._chain: Chain | None = None
        self.rules: Final = {
            name: MarketRules(name, head=lambda: self.head, resolver=self.resolve, validators=self, blocked=blocked)
            for name in lighthouses
        }
        self.head = 0
        """The latest block number; 0 while it isn't known."""
        self.error = ""
        """The last error, empty while all is well."""

    async def resolve(self, name: str) -> str:
        """The address of an ENS name. Raises `ChainError`."""
        return await self._reached.names.address(name)

    def known(self, validator: str) -> bool | None:
        """Whether orders may name a validator (address); None if that has to be asked."""
        return None if self._chain is None else self._chain.validators.known(validator)

    async def is_safe(self, validator: str) -> bool:
        """The same, asked. Raises `ChainError`."""
        return await self._reached.validators.is_safe(validator)

    @property
    def _reached(self) -> Chain:
        if self._chain is None:
            raise ChainError("the chain's node was not reached yet", code="chain-awaited")
        return self._chain

    async def run(self) -> None:
        """Follow the chain until cancelled. Raises `ConfigurationError` for a chain that contradicts the settings."""
        backoff = Backoff(self._retry)
        while True:
            try:
                async with self._make_chain() as self._chain:
                    log.info("the chain's node is reachable", extra=log_event("chain-connected"))
                    backoff.reset()
                    while True:
                        await self._read(self._chain)
                        await asyncio.sleep(self._interval)
            except ChainError as error:
                self._failed(error, "deadlines and ENS names are not checked until the chain's node is reachable")
            finally:
                self._chain = None
            await backoff.wait()

    async def _read(self, chain: Chain) -> None:
        """Read the head and unknown addresses. After an outage of the node, its client reconnects by itself."""
        try:
            self.head = await chain.contract_block()
            for name, rules in self.rules.items():
                if rules.address is None:
                    rules.address = await chain.names.address(name)
        except ChainError as error:
            self._failed(error, "the latest block or a lighthouse's address could not be read")
        else:
            self.error = ""
            self._outage.recovered("deadlines and ENS names are checked")

    def _failed(self, error: ChainError, consequence: str) -> None:
        self._outage.failed(error, consequence)
        self.error = str(error)


class IpfsBridge(Role):
    """Bridges the channels of `lighthouses` (ENS names) and content: `async with IpfsBridge(...)`, then `run`.

    `chain` creates an unopened client of the chain. With it, and once its node is reachable, ENS names in messages are
    resolved, orders must name the lighthouse's address, and expired orders are rejected. `address` identifies the
    bridge on the mesh, by default a random one. The caller closes the network.
    """

    title = "IPFS bridge"

    def __init__(
        self,
        network: Network,
        settings: Settings,
        *,
        lighthouses: tuple[str, ...] = (),
        chain: Callable[[], AbstractAsyncContextManager[Chain]] | None = None,
        address: str | None = None,
    ) -> None:
        self._network = network
        self._settings = settings
        self._lighthouses = tuple(name.lower() for name in lighthouses or (settings.lighthouse_contract,))
        blocked = blocklist_at(settings.blocked_signers)
        interval = max(settings.poll_interval, 1.0)
        self._chain = chain and ChainView(chain, self._lighthouses, interval=interval, blocked=blocked)
        self._rules = {name: MarketRules(name, blocked=blocked) for name in self._lighthouses}
        if self._chain is not None:
            self._rules = self._chain.rules
        own = Signer(secrets.token_bytes(32))
        self._signer = None if address else own
        """Signs declines, if nobody else has the key of its address."""
        self._address = (address or own.address).lower()
        self.channels: tuple[ChannelBridge, ...] = ()
        self.drops: Final = Drops()
        """What strangers sent that was dropped."""
        self.daemon: Final = Daemon(settings.ipfs_http_provider, authorization=authorization_of(settings))

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self.daemon)
        self.content = await self._open_content(stack)
        self.channels = tuple([await self._open_channel(stack, name) for name in self._lighthouses])

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for channel in self.channels:
                tasks.create_task(channel.run(), name=f"bridge of {channel.lighthouse}")
            tasks.create_task(self.drops.run(), name="bridge: drops")
            if self._chain is not None:
                tasks.create_task(self._chain.run(), name="bridge: the chain")

    async def measure(self) -> Iterable[MetricFamily]:
        return (
            *bridge_families(channel.health() for channel in self.channels),
            *content_families(self.content.metrics()),
            drop_family(self.drops),
            *self._network.families(),
        )

    def parts(self) -> Mapping[str, str]:
        """The health of each part: the router, and the daemon for each channel."""
        return health_parts(channel.health() for channel in self.channels)

    @property
    def _directory(self) -> Path:
        return self._settings.state_directory / "bridge" / "ipfs"

    async def _open_content(self, stack: AsyncExitStack) -> ContentBridge:
        settings = self._settings
        limit = settings.objective_size_limit
        store = await open_store(stack, settings, self._directory / "content", limit=limit)
        exchange = Exchange(self._network.session, store, address=self._address, drops=self.drops)
        await stack.enter_async_context(exchange)
        gateways = [Gateway(settings.ipfs_gateway)] if settings.ipfs_gateway else []
        for gateway in gateways:
            await stack.enter_async_context(gateway)
        providers = tuple(Daemon(api) for api in settings.ipfs_public_providers)
        for provider in providers:
            await stack.enter_async_context(provider)
        parts = ContentParts(
            session=self._network.session,
            store=store,
            exchange=exchange,
            sources=ContentSources(self.daemon, *gateways),
            daemon=self.daemon,
            providers=providers,
            size_limit=settings.objective_size_limit,
            timeout=settings.fetch_timeout,
            drops=self.drops,
        )
        return await stack.enter_async_context(ContentBridge(parts, address=self._address))

    async def _open_channel(self, stack: AsyncExitStack, lighthouse: str) -> ChannelBridge:
        withdrawals = stack.enter_context(
            Withdrawals(MarketStore(self._directory / f"withdrawals-{lighthouse}.sqlite"))
        )
        rules, large_numbers = self._rules[lighthouse], self._settings.ipfs_large_numbers
        validator = RelayValidator(rules, withdrawals=withdrawals, large_numbers=large_numbers)
        parts = BridgeParts(
            network=self._network,
            daemon=self.daemon,
            validator=validator,
            journal=stack.enter_context(RelayJournal(self._directory / f"{lighthouse}.sqlite")),
            drops=self.drops,
            signer=self._signer,
            published=self._published,
            content=self.content.metrics,
        )
        swarm_peers = self._settings.ipfs_swarm_connect
        return await stack.enter_async_context(ChannelBridge(parts, address=self._address, swarm_peers=swarm_peers))

    def _published(self, side: Side, message: RelayMessage) -> None:
        """Transfer the file that a message names to the side to which the message was sent."""
        transfers = self.content.adds if side is Side.IPFS else self.content.fetches
        match decode(message.payload):
            case Demand(objective=cid):
                transfers.add(cid, message.signer)
            case Result(result=cid):
                transfers.add(cid, message.signer, priority=URGENT)
