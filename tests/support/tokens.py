"""The token of the contracts' tests that refuses to pay accounts on its blocklist, on a chain of `mesh.chain`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain import TransactionSender
from mesh.chain._abi import encode
from schemas import keccak256
from tests.support.contracts.suite import artifact

if TYPE_CHECKING:
    from mesh.chain import Chain


async def deploy_blocking_token(chain: Chain, supply: int) -> str:
    """Deploy the token, all of which the chain's account has; its address."""
    assert chain.account is not None
    creation = bytes.fromhex(artifact("BlockingToken")["bytecode"][2:]) + encode(["uint256"], [supply])
    receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=creation)
    assert receipt.contract is not None
    return receipt.contract


async def block(chain: Chain, token: str, account: str, *, is_blocked: bool = True) -> None:
    """Put an account on the token's blocklist, or take it off."""
    assert chain.account is not None
    data = keccak256(b"setBlocked(address,bool)")[:4] + encode(["address", "bool"], [account, is_blocked])
    await TransactionSender(chain.node, chain.account).send(to=token, data=data)
