"""Whether an account can be a provider at all: asked before it begins, so that a person hears of it at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.chain import InsufficientFunds
from mesh.market.turns import NoStake

if TYPE_CHECKING:
    from mesh.chain import Chain

GAS_OF_ONE: Final = 200_000
"""What a transaction of a provider takes at least, about."""


async def check_standing(chain: Chain, lighthouse: str) -> None:
    """Raise `NoStake` or `InsufficientFunds` where the chain's account can't send anything to a lighthouse.

    Later, when it may have become so, a provider waits instead. Raises what reading the chain does.
    """
    assert chain.account is not None
    address = chain.account.address
    state = await chain.lighthouses.get(lighthouse)
    if address not in state.stakes:
        raise NoStake(address, lighthouse, minimal_stake=state.minimal_stake)
    balance, price = await chain.tokens.eth_balance(), int(await chain.node.web3.eth.gas_price)
    if balance < GAS_OF_ONE * price:
        raise InsufficientFunds(address, balance=balance, needed=GAS_OF_ONE * price)
