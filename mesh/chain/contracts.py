"""The contracts on one chain, and the sender of transactions to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from mesh.chain.errors import NoAccount

if TYPE_CHECKING:
    from web3.contract import AsyncContract
    from web3.contract.async_contract import AsyncContractFunction

    from mesh.chain.names import Names
    from mesh.chain.node import Node
    from mesh.chain.transactions import Receipt, TransactionSender
    from mesh.chain.versions import ContractVersion


@dataclass(frozen=True, slots=True, kw_only=True)
class Contracts:
    """The parts that an open `Chain` shares. `factory` and `xrt` are addresses; `sender` is None for reading only."""

    node: Node
    names: Names
    version: ContractVersion
    factory: str
    xrt: str
    sender: TransactionSender | None

    @property
    def own_address(self) -> str:
        """The address of the account that signs. Raises `NoAccount`."""
        return self.signing().account.address

    def signing(self) -> TransactionSender:
        """The sender of the account's transactions. Raises `NoAccount`."""
        if self.sender is None:
            raise NoAccount
        return self.sender

    async def send(self, function: AsyncContractFunction) -> Receipt:
        """Send a call as the account and wait until it is mined. Raises as `TransactionSender.send` does."""
        return await self.signing().call(function)

    async def address_or_own(self, name_or_address: str | None) -> str:
        """The address of a name; the account's own for None."""
        return self.own_address if name_or_address is None else await self.names.address(name_or_address)

    def factory_contract(self) -> AsyncContract:
        """The factory."""
        return self.node.contract("Factory", self.factory)

    async def lighthouse_contract(self, lighthouse: str) -> AsyncContract:
        """The lighthouse of that name or address."""
        return self.node.contract("Lighthouse", await self.names.lighthouse(lighthouse))
