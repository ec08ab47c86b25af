"""The IPFS bridge of one process, as the settings describe it."""

from __future__ import annotations

import asyncio
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bridges.ipfs.channel import ChannelBridge
from bridges.ipfs.content import ContentBridge
from bridges.ipfs.daemon import Daemon
from bridges.ipfs.journal import RelayJournal, Side
from bridges.ipfs.status import bridge_families, content_families, health_parts
from bridges.ipfs.transfer_queue import URGENT, USUAL
from bridges.ipfs.transfers import ContentSources, Gateway
from bridges.ipfs.validation import ChainView, RelayValidator
from mesh.blocklist import blocklist_at
from mesh.content import Exchange, Store
from mesh.errors import ConfigurationError
from mesh.flood import Drops
from mesh.market.withdrawals import Withdrawals
from mesh.network.metrics import drop_family, network_families
from mesh.role import Role
from schemas import Demand, Result, decode, recover

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AbstractAsyncContextManager, AsyncExitStack

    from bridges.ipfs.validation import RelayMessage
    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import IpfsSettings, Settings
    from mesh.telemetry.metrics import MetricFamily


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
        self._chain = chain and ChainView(chain, self._lighthouses, interval=max(settings.poll_interval, 1.0))
        self._address = (address or f"0x{secrets.token_hex(20)}").lower()
        self.channels: tuple[ChannelBridge, ...] = ()
        self._blocked = blocklist_at(settings.blocked_signers)
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
        """The metrics of each channel, of content and of the session."""
        return (
            *bridge_families(channel.health() for channel in self.channels),
            *content_families(self.content.metrics()),
            drop_family(self.drops),
            *network_families(self._network),
        )

    def parts(self) -> Mapping[str, str]:
        """The health of each part: the router, and the daemon for each channel."""
        return health_parts(channel.health() for channel in self.channels)

    @property
    def _directory(self) -> Path:
        return self._settings.state_directory / "bridge" / "ipfs"

    async def _open_content(self, stack: AsyncExitStack) -> ContentBridge:
        settings = self._settings
        store = await asyncio.to_thread(
            Store, self._directory / "content", limit=settings.objective_size_limit, quota=settings.content_limit
        )
        stack.callback(store.close)
        exchange = Exchange(self._network.session, store, address=self._address, drops=self.drops)
        await stack.enter_async_context(exchange)
        gateways = [Gateway(settings.ipfs_gateway)] if settings.ipfs_gateway else []
        for gateway in gateways:
            await stack.enter_async_context(gateway)
        providers = tuple(Daemon(api) for api in settings.ipfs_public_providers)
        for provider in providers:
            await stack.enter_async_context(provider)
        return await stack.enter_async_context(
            ContentBridge(
                self._network.session,
                store,
                exchange,
                ContentSources(self.daemon, *gateways),
                self.daemon,
                providers=providers,
                address=self._address,
                drops=self.drops,
                size_limit=settings.objective_size_limit,
                timeout=settings.fetch_timeout,
            )
        )

    async def _open_channel(self, stack: AsyncExitStack, lighthouse: str) -> ChannelBridge:
        return await stack.enter_async_context(
            ChannelBridge(
                self._network,
                self.daemon,
                self._validator(
                    lighthouse, stack.enter_context(Withdrawals(self._directory / f"withdrawals-{lighthouse}.sqlite"))
                ),
                stack.enter_context(RelayJournal(self._directory / f"{lighthouse}.sqlite")),
                lighthouse=lighthouse,
                swarm_peers=self._settings.ipfs_swarm_connect,
                address=self._address,
                published=self._published,
                content=self.content.metrics,
                drops=self.drops,
            )
        )

    def _validator(self, lighthouse: str, withdrawals: Withdrawals) -> RelayValidator:
        chain = self._chain
        if chain is None:
            return RelayValidator(lighthouse, withdrawals=withdrawals, blocked=self._blocked)
        return RelayValidator(
            lighthouse,
            withdrawals=withdrawals,
            address=lambda: chain.address(lighthouse),
            resolver=chain.resolve,
            is_safe=chain.is_safe_validator,
            head=lambda: chain.head,
            blocked=self._blocked,
        )

    def _published(self, side: Side, message: RelayMessage) -> None:
        """Transfer the file that a message names to the side to which the message was sent."""
        match named := decode(message.payload):
            case Demand(objective=cid) | Result(result=cid):
                signer = recover(bytes.fromhex(message.hash), named.signature)
                priority = URGENT if isinstance(named, Result) else USUAL
                if side is Side.IPFS:
                    self.content.schedule_add(cid, signer, priority=priority)
                else:
                    self.content.schedule_fetch(cid, signer, priority=priority)


def authorization_of(settings: IpfsSettings) -> str:
    """The daemon's `Authorization` header, empty if it needs none. Raises `ConfigurationError`."""
    if not settings.ipfs_authorization_file:
        return ""
    path = Path(settings.ipfs_authorization_file).expanduser()
    try:
        value = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"can't read the IPFS credentials in {path}: {error}") from None
    if not value.isascii() or not value.isprintable():
        raise ConfigurationError(
            f"{path} does not hold the value of a header", hint="one line, such as Bearer … or Basic …"
        )
    return value
