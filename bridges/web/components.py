"""What the page's server has open: router, chain, files, and perhaps an account."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mesh.agent.agent import Agent
from mesh.agent.validators import ValidatorDirectory
from mesh.base.flood import Drops
from mesh.chain import Account, new_private_key
from mesh.content import Exchange, Store
from mesh.role.composition import chain_of, connected, open_store
from mesh.role.following import ChainHead
from mesh.watching import RobotDirectory

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.chain import Chain
    from mesh.network import Channel, Network
    from mesh.settings import Settings
    from schemas.signing import Signer


@dataclass(frozen=True, kw_only=True)
class WebComponents:
    """The open components of the page's server. `agent` is that of the local account, if there is one."""

    settings: Settings
    network: Network
    channel: Channel
    chain: Chain
    chain_head: ChainHead
    store: Store
    exchange: Exchange
    drops: Drops
    validators: ValidatorDirectory
    robots: RobotDirectory
    agent: Agent | None
    asker: Signer
    """Who asks robots for quotes: the local account, or a key that lives as long as the server."""
    lighthouse: str
    """The lighthouse's address."""
    token: str
    """The address of the token that pays for work."""


@asynccontextmanager
async def opened(
    settings: Settings, *, account: Account | None = None, chain: Chain | None = None, agent: Agent | None = None
) -> AsyncIterator[WebComponents]:
    """The components, with the settings' account or `account`, on `chain` (open) or on the settings' own.

    With `agent` (open) they are that agent's. Raises `ConfigurationError`, `NetworkUnavailable`, `ChainError`.
    """
    settings = replace(settings, metrics_listen="", enable_executor=False)
    drops = Drops()
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        if agent is None and (account is not None or settings.keyfile):
            agent = await enter(Agent(settings=settings, account=account, chain=chain))
        if agent is not None:
            parts = agent.parts
            network, channel, store, exchange = parts.network, parts.channel, parts.store, parts.exchange
            opened_chain, drops = parts.chain, parts.drops
            head = await ChainHead.at(opened_chain, await opened_chain.block_number())
        else:
            opened_chain = await enter(chain_of(settings, None)) if chain is None else chain
            head = await ChainHead.at(opened_chain, await opened_chain.block_number())
            network, channel = await enter(connected(settings, opened_chain, head, drops))
            folder, limit = settings.state_directory / "content", settings.objective_expanded_limit
            store = await open_store(stack, settings, folder, limit=limit)
            holder = await asyncio.to_thread(_holder, settings)
            exchange = await enter(Exchange(network.session, store, address=holder, drops=drops))
        yield WebComponents(
            settings=settings,
            network=network,
            channel=channel,
            chain=opened_chain,
            chain_head=head,
            store=store,
            exchange=exchange,
            drops=drops,
            validators=ValidatorDirectory(network.session, channel, opened_chain),
            robots=RobotDirectory(network.session, channel) if agent is None else agent.parts.robots,
            agent=agent,
            asker=Account(new_private_key()).signer if agent is None else agent.parts.signer,
            lighthouse=await opened_chain.names.address(settings.lighthouse_contract),
            token=await opened_chain.tokens.address(settings.erc20_token),
        )


def _holder(settings: Settings) -> str:
    """Whose space on the site's routers is the server's own: its certificate's holder; empty without a certificate."""
    if not settings.tls_certificate:
        return ""
    from mesh.ops.identity.certificates import holder_address

    return holder_address(settings.tls_certificate)
