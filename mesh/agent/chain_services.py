"""Services of an agent's account: what it has, and what it sends, in ether (wei) and in the settings' token (wn)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas.rpc import Accounts, Allowance, Balance, BlockNumber, Transaction

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.agent.components import AgentComponents
    from schemas import Record
    from schemas.rpc import (
        AccountBalance,
        AccountToAddressAllowance,
        Approve,
        Nothing,
        TransferFromRequest,
        TransferRequest,
    )


class ChainServices:
    """`eth/…`. Their token, also of those with `xrt` in their names, is the setting `erc20_token`, as it always was.

    Accounts may be given as addresses or ENS names. What the chain refuses travels to who asked.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._chain = parts.chain
        self._account = parts.signer.address
        self._token = parts.settings.erc20_token

    def answers(self) -> dict[str, Callable[[Any], Awaitable[Record]]]:
        """What is answered, by the name of the service."""
        return {
            "eth/accounts": self.accounts,
            "eth/current_block": self.current_block,
            "eth/account_eth_balance": self.account_eth_balance,
            "eth/eth_balance": self.eth_balance,
            "eth/account_xrt_balance": self.account_xrt_balance,
            "eth/xrt_balance": self.xrt_balance,
            "eth/account_xrt_allowance": self.account_xrt_allowance,
            "eth/xrt_allowance": self.xrt_allowance,
            "eth/transfer": self.transfer,
            "eth/transfer_from": self.transfer_from,
            "eth/approve": self.approve,
        }

    async def accounts(self, _request: Nothing) -> Accounts:
        """The one account of this agent."""
        return Accounts((self._account,))

    async def current_block(self, _request: Nothing) -> BlockNumber:
        """The chain's newest block."""
        return BlockNumber(await self._chain.block_number())

    async def account_eth_balance(self, request: AccountBalance) -> Balance:
        """Anybody's wei."""
        return Balance(await self._chain.tokens.eth_balance(request.account))

    async def eth_balance(self, _request: Nothing) -> Balance:
        """This agent's wei."""
        return Balance(await self._chain.tokens.eth_balance(self._account))

    async def account_xrt_balance(self, request: AccountBalance) -> Balance:
        """Anybody's tokens."""
        return Balance(await self._chain.tokens.balance(request.account, token=self._token))

    async def xrt_balance(self, _request: Nothing) -> Balance:
        """This agent's tokens."""
        return Balance(await self._chain.tokens.balance(self._account, token=self._token))

    async def account_xrt_allowance(self, request: AccountToAddressAllowance) -> Allowance:
        """What one may take of another's tokens."""
        return Allowance(await self._chain.tokens.allowance(request.account, request.to, token=self._token))

    async def xrt_allowance(self, _request: Nothing) -> Allowance:
        """What the factory may take of this agent's tokens, for costs and fees."""
        return Allowance(await self._chain.tokens.allowance(self._account, self._chain.factory, token=self._token))

    async def transfer(self, request: TransferRequest) -> Transaction:
        """Send tokens of this agent; answered once they are there."""
        return Transaction(await self._chain.tokens.transfer(request.to, int(request.value), token=self._token))

    async def transfer_from(self, request: TransferFromRequest) -> Transaction:
        """Send tokens that their owner has approved for this agent; answered once they are there."""
        tx = await self._chain.tokens.transfer_from(request.owner, request.to, int(request.value), token=self._token)
        return Transaction(tx)

    async def approve(self, request: Approve) -> Transaction:
        """Let somebody take tokens of this agent; answered once the chain has it."""
        return Transaction(await self._chain.tokens.approve(request.spender, int(request.value), token=self._token))
