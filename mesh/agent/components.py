"""What an agent with an account has open."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.agent.ledger import Ledger, Outbox
from mesh.base.private_files import make_private_folder
from mesh.errors import ConfigurationError
from mesh.role.composition import RoleParts, open_parts, opened_chain
from mesh.role.program import RESEND
from mesh.watching.robots import RobotDirectory

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.base.flood import Drops
    from mesh.base.retry import RetryPolicy
    from mesh.chain import Account, Chain
    from mesh.settings import Settings

LEDGER: Final = "ledger.sqlite"
"""The name of the ledger in an account's folder for a chain."""


@dataclass(frozen=True, kw_only=True)
class AgentComponents(RoleParts[Ledger]):
    """The open components of an agent with an account."""

    outbox: Outbox
    robots: RobotDirectory

    @property
    def recordings(self) -> Path:
        """The folder of unfinished recordings; finished ones are in the store."""
        return self.directory / "recordings"


@asynccontextmanager
async def working(
    settings: Settings, account: Account, chain: Chain | None, *, drops: Drops, resend: RetryPolicy = RESEND
) -> AsyncIterator[AgentComponents]:
    """The components of an agent with an account, on `chain` (open), or on the chain that the settings name."""
    async with AsyncExitStack() as stack:
        chain = await opened_chain(stack, settings, account, chain)
        depth = chain.node.timing.reorg_depth

        def ledger(folder: Path) -> Ledger:
            return Ledger(folder / LEDGER, reorg_depth=depth)

        shared = await open_parts(stack, settings, account, chain, ledger=ledger, drops=drops)
        head = shared.chain_head
        outbox = Outbox(shared.ledger, shared.channel, shared.network, head=lambda: head.contract_block, policy=resend)
        robots = RobotDirectory(shared.network.session, shared.channel)
        parts = AgentComponents(**vars(shared), outbox=outbox, robots=robots)
        try:
            make_private_folder(parts.recordings)
        except OSError as error:
            raise ConfigurationError(
                f"can't keep recordings in {parts.recordings}: {error.strerror}",
                hint="give another folder with --data-dir",
            ) from None
        yield parts
