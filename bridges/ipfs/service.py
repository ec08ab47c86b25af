"""All of the IPFS bridge as the settings describe it, for one process."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bridges.ipfs.channel import ChannelBridge
from bridges.ipfs.content import ContentBridge
from bridges.ipfs.daemon import Daemon
from bridges.ipfs.gate import Gate
from bridges.ipfs.gateway import Gateway
from bridges.ipfs.journal import Journal
from bridges.ipfs.market import Markets
from bridges.ipfs.memory import Side
from bridges.ipfs.metrics import bridge_families, content_families, parts_of
from bridges.ipfs.sources import Sources
from mesh.content import Exchange, Store
from mesh.errors import ConfigurationError
from mesh.network.metrics import network_families
from mesh.role import Role
from schemas import Demand, Result, decode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AbstractAsyncContextManager, AsyncExitStack

    from bridges.ipfs.gate import Passenger
    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily


class IpfsBridge(Role):
    """The channels of `lighthouses` (ENS names) and the content: `async with IpfsBridge(...) as bridge`, then `run`.

    With `chain`, which makes a client of it that is not open yet, ENS names in messages are looked up, orders must be
    of the lighthouse's address, and those whose deadline has passed do not cross: from the moment on when its node was
    reached. `address` is the bridge's name on the mesh, by default a new one for each channel. The network stays the
    caller's to close.
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
        self._markets = chain and Markets(chain, self._lighthouses, interval=max(settings.poll_interval, 1.0))
        self._address = address
        self.channels: tuple[ChannelBridge, ...] = ()
        self.daemon: Final = Daemon(settings.ipfs_http_provider, authorization=authorization_of(settings))

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self.daemon)
        self.content = await self._open_content(stack)
        self.channels = tuple([await self._open_channel(stack, name) for name in self._lighthouses])

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for channel in self.channels:
                tasks.create_task(channel.run(), name=f"bridge of {channel.lighthouse}")
            if self._markets is not None:
                tasks.create_task(self._markets.run(), name="bridge: the chain")

    async def measure(self) -> Iterable[MetricFamily]:
        """Its figures: of each channel, of the content, and of its session."""
        return (
            *bridge_families(channel.standing() for channel in self.channels),
            *content_families(self.content.figures()),
            *network_families(self._network),
        )

    def parts(self) -> Mapping[str, str]:
        """The state of each of its parts: the router, and for each channel the daemon."""
        return parts_of(channel.standing() for channel in self.channels)

    @property
    def _directory(self) -> Path:
        return self._settings.state_directory / "bridge" / "ipfs"

    async def _open_content(self, stack: AsyncExitStack) -> ContentBridge:
        settings = self._settings
        store = await asyncio.to_thread(
            Store, self._directory / "content", limit=settings.objective_size_limit, quota=settings.content_limit
        )
        stack.callback(store.close)
        exchange = await stack.enter_async_context(Exchange(self._network.session, store))
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
                Sources(self.daemon, *gateways),
                self.daemon,
                providers=providers,
                size_limit=settings.objective_size_limit,
                timeout=settings.fetch_timeout,
            )
        )

    async def _open_channel(self, stack: AsyncExitStack, lighthouse: str) -> ChannelBridge:
        return await stack.enter_async_context(
            ChannelBridge(
                self._network,
                self.daemon,
                self._gate(lighthouse),
                stack.enter_context(Journal(self._directory / f"{lighthouse}.sqlite")),
                lighthouse=lighthouse,
                neighbours=self._settings.ipfs_swarm_connect,
                address=self._address,
                carried=self._carried,
                content=self.content.figures,
            )
        )

    def _gate(self, lighthouse: str) -> Gate:
        markets = self._markets
        if markets is None:
            return Gate(lighthouse)
        return Gate(
            lighthouse,
            address=lambda: markets.address(lighthouse),
            resolver=markets.resolve,
            head=lambda: markets.head,
        )

    def _carried(self, side: Side, passenger: Passenger) -> None:
        """Content goes the way of the messages that name it."""
        match decode(passenger.payload):
            case Demand(objective=cid) | Result(result=cid):
                if side is Side.IPFS:
                    self.content.add_soon(cid)
                else:
                    self.content.fetch_soon(cid)


def authorization_of(settings: Settings) -> str:
    """The `Authorization` header that the daemon wants, none if empty. Raises `ConfigurationError`."""
    if not settings.ipfs_authorization_file:
        return ""
    path = Path(settings.ipfs_authorization_file).expanduser()
    try:
        value = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"can't read the IPFS credentials in {path}: {error}") from None
    if not value.isascii() or not value.isprintable():
        raise ConfigurationError(f"{path} holds no value of a header", hint="one line, such as Bearer … or Basic …")
    return value
