"""The chain as the mesh uses it: names, tokens, liabilities, lighthouses, events; one account that signs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain.errors import NotALiability
from mesh.chain.events import liability_created, lighthouse_created
from mesh.chain.opening import OpenChain
from mesh.chain.reader import BlockEvents, Sources, find_lighthouses, read_blocks
from mesh.chain.records import Created, LighthouseState, Settled, read_liability
from schemas.packing import order_abi

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterable

    from mesh.chain.events import NewLighthouse
    from mesh.chain.history import History
    from schemas.liability import Liability
    from schemas.messages import Demand, Offer, Result


class Chain(OpenChain):
    """The contracts of the network on the chain at `endpoint` (see `Node`), for one `account` or for reading only.

    `contracts` says whether they are this project's (`"mesh"`, which read both generations of orders) or the
    originals (`"original"`) of a `generation`; the generation also names the root under which names are looked for.
    `ens` is the address of the ENS registry (empty: the public or a development chain's); `factory` and `xrt` are
    names or addresses, empty for those under that root. `timing`, `fees` and `journal` are the node's (see `Node`);
    a given node has its own.

    Amounts are ints: wei for ETH, wn for XRT, a token's smallest unit otherwise. Addresses are EIP-55; where a
    lighthouse, token or account is asked for, an ENS name does as well.

    Used with `async with`, which raises `NodeUnreachable`, `NoContracts` and `UnknownName`. Every method raises
    `NodeUnreachable` when the node is lost. What sends a transaction waits until it is mined and raises `NoAccount`,
    `Reverted` (also without sending, when the simulation fails), `InsufficientFunds`, `TransactionTimeout`.
    """

    async def eth_balance(self, address: str | None = None) -> int:
        """Wei of an account; of one's own by default."""
        return await self.node.eth_balance(await self._whose(address))

    async def balance_of(self, address: str | None = None, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that an account holds."""
        contract = await self._token(token)
        return int(await self.node.read(contract.functions.balanceOf(await self._whose(address))))

    async def allowance(self, owner: str, spender: str, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that `spender` may take from `owner`."""
        functions = (await self._token(token)).functions
        return int(await self.node.read(functions.allowance(await self.resolve(owner), await self.resolve(spender))))

    async def approve(self, spender: str, value: int, *, token: str | None = None) -> str:
        """Let `spender` take up to `value` units of a token (XRT by default); the transaction's hash."""
        functions = (await self._token(token)).functions
        return (await self._send(functions.approve(await self.resolve(spender), value))).tx

    async def transfer(self, to: str, value: int, *, token: str | None = None) -> str:
        """Send units of a token (XRT by default); the transaction's hash."""
        functions = (await self._token(token)).functions
        return (await self._send(functions.transfer(await self.resolve(to), value))).tx

    async def transfer_from(self, owner: str, to: str, value: int, *, token: str | None = None) -> str:
        """Send what `owner` approved for this account; the transaction's hash."""
        functions = (await self._token(token)).functions
        return (await self._send(functions.transferFrom(await self.resolve(owner), await self.resolve(to), value))).tx

    async def send_eth(self, to: str, value: int) -> str:
        """Send `value` wei; the transaction's hash."""
        return (await self._signing().send(to=await self.resolve(to), data=b"", value=value)).tx

    async def nonce_of(self, address: str | None = None) -> int:
        """The nonce that an account's next generation-5 order must have."""
        return await self._suite.nonce_of(await self._whose(address))

    async def is_order_used(self, order_hash: bytes) -> bool:
        """Whether a generation-3 order was used already (generation 5 is told by its nonce)."""
        return bool(await self.node.read(self._factory_contract().functions.isHashConsumed(order_hash)))

    async def liability(self, address: str) -> Liability:
        """The record of a liability. Raises `NotALiability` unless the factory made it."""
        address = await self.resolve(address)
        if not await self.is_liability(address):
            raise NotALiability(address)
        return await read_liability(self.node, address)

    async def order_hashes(self, liability: str) -> tuple[bytes, bytes]:
        """The hashes of the demand and of the offer that a liability was made of."""
        functions = self.node.contract("Liability", liability).functions
        demand_hash = await self.node.read(functions.demandHash())
        return bytes(demand_hash), bytes(await self.node.read(functions.offerHash()))

    async def is_liability(self, address: str) -> bool:
        """Whether the factory made the contract at an address."""
        return await self._suite.is_liability(address)

    async def create_liability(self, lighthouse: str, demand: Demand, offer: Offer) -> Created:
        """Make a liability of two signed orders, as a provider of the lighthouse.

        Raises `InvalidMessage` for an unsigned order or one with a name that is not resolved.
        """
        for order in (demand, offer):
            self._suite.check_order(order)
        functions = (await self._lighthouse(lighthouse)).functions
        receipt = await self._send(functions.createLiability(order_abi(demand), order_abi(offer)))
        created = Created(liability_created(receipt.logs).liability, receipt.tx, receipt.gas_used)
        self._suite.recognise(created.liability)
        return created

    async def finalize(self, lighthouse: str, result: Result) -> Settled:
        """Finalize a liability by its signed result, as a provider of the lighthouse."""
        functions = (await self._lighthouse(lighthouse)).functions
        receipt = await self._send(self._suite.finalization(functions, result))
        return Settled(receipt.tx, receipt.gas_used)

    async def validate(self, result: Result, *, agree: bool) -> Settled:
        """Finalize a generation-3 liability as the validator that it names.

        Without `agree` the promisee is paid back, as for a result without success.
        """
        receipt = await self._send(self._suite.validation(result, agree=agree))
        return Settled(receipt.tx, receipt.gas_used)

    async def refundable_from(self, liability: str) -> int:
        """The block from which anyone may have the promisee paid back, if the liability is not finalized by then."""
        return await self._suite.refundable_from(liability)

    async def refund(self, liability: str) -> Settled:
        """Pay back the promisee of a liability that was never finalized."""
        receipt = await self._send(self._suite.refund(liability))
        return Settled(receipt.tx, receipt.gas_used)

    async def lighthouse(self, lighthouse: str) -> LighthouseState:
        """The state of a lighthouse: stakes, turn, quota."""
        return await self._suite.state(await self.lighthouse_address(lighthouse))

    async def is_turn(self, lighthouse: str, address: str | None = None) -> bool:
        """Whether a provider (one's own account by default) may send to a lighthouse in the next block."""
        return await self._suite.is_turn(await self.lighthouse_address(lighthouse), await self._whose(address))

    async def lighthouses(self, *, from_block: int = 0) -> list[NewLighthouse]:
        """All lighthouses made since a block, in order."""
        return await find_lighthouses(self.node, self._sources(()), from_block)

    async def create_lighthouse(self, *, minimal_stake: int, timeout_blocks: int, name: str) -> NewLighthouse:
        """Make a market. `minimal_stake` in wn; `name` is one label of a to z, 0 to 9 and -."""
        function = self._factory_contract().functions.createLighthouse
        return lighthouse_created((await self._send(function(minimal_stake, timeout_blocks, name))).logs)

    async def refill(self, lighthouse: str, value: int) -> str:
        """Stake `value` wn, for which the lighthouse must be approved, and become a provider; the tx hash."""
        return (await self._send((await self._lighthouse(lighthouse)).functions.refill(value))).tx

    async def withdraw(self, lighthouse: str, value: int) -> str:
        """Take `value` wn off the stake, or all of it where less than the minimum would remain; the tx hash."""
        return (await self._send((await self._lighthouse(lighthouse)).functions.withdraw(value))).tx

    def events(
        self, from_block: int, *, lighthouses: Iterable[str] = (), history: History | None = None
    ) -> AsyncGenerator[BlockEvents, None]:
        """Events from a block on, for ever (see `read_blocks`); those of lighthouses only of the given addresses.

        Blocks that the chain replaced are told as `Reorganised`, also from before where the `history` is given that
        an earlier iterator filled.
        """
        return read_blocks(self.node, self._sources(lighthouses), from_block, history=history)

    def _sources(self, lighthouses: Iterable[str]) -> Sources:
        return Sources(
            factory=self.factory,
            xrt=self.xrt,
            lighthouses=tuple(lighthouses),
            is_liability=self.is_liability,
            recognise=self._suite.recognise,
        )
