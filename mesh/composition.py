"""From settings to open parts: the account, the chain and the network that the settings name.

The command line, agents, bridges and tests compose their parts here, and nowhere else. The chain is imported on first
use: what runs without one never loads it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

from mesh.network import Endpoints

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.chain import Account, Chain
    from mesh.settings import AccountSettings, ChainSettings, NetworkSettings


def load_account(settings: AccountSettings) -> Account:
    """The account that the settings name. Blocks while the keyfile is decrypted. Raises `ConfigurationError`."""
    from mesh.chain import Account

    return Account.from_keyfile(*settings.keyfile_and_password())


def chain_of(settings: ChainSettings, account: Account | None, *, attempts: int = 4) -> Chain:
    """The chain that the settings name, not yet opened, for `account` or for reading only.

    A request is made up to `attempts` times before the node counts as unreachable.

    What is sent is written down in the settings' folder, so that a number that was used stays used after a restart,
    and in other programs of the same account. Raises `ConfigurationError`.
    """
    from mesh.chain import GWEI, Chain, FeePolicy, Timing

    return Chain(
        settings.node,
        account=account,
        ens=settings.ens_contract,
        factory=settings.factory_contract,
        xrt=settings.xrt_contract,
        generation=settings.generation,
        contracts=settings.contracts,
        timing=Timing(
            poll_interval=settings.poll_interval,
            confirmations=settings.confirmations,
            reorg_depth=settings.reorg_depth,
            attempts=attempts,
        ),
        fees=FeePolicy(ceiling=round(settings.max_fee_gwei * GWEI)),
        transactions=settings.state_directory / "transactions",
    )


class ProviderFiles(TypedDict):
    """The files of a `Provider`, as it takes them."""

    withdrawals: Path
    sent_orders: Path


def provider_files(folder: Path, lighthouse: str) -> ProviderFiles:
    """The files of the provider of a lighthouse (ENS name), in the folder of its account."""
    name = f"{lighthouse.lower()}.sqlite"
    return ProviderFiles(withdrawals=folder / f"withdrawals-{name}", sent_orders=folder / f"sent-orders-{name}")


def endpoints_of(settings: NetworkSettings) -> Endpoints:
    """Where the settings' client session connects to."""
    return Endpoints.from_settings(settings)
