"""Chains that the contracts run on in tests: py-evm in this process, and anvil where it is installed."""

from __future__ import annotations

from ast import literal_eval
from typing import TYPE_CHECKING, Any, Final

import requests
from eth_tester import EthereumTester, PyEVMBackend  # type: ignore[import-untyped]
from eth_tester.exceptions import TransactionFailed  # type: ignore[import-untyped]
from web3 import EthereumTesterProvider, HTTPProvider, Web3
from web3.exceptions import ContractLogicError, Web3RPCError
from web3.middleware import AttributeDictMiddleware

import mesh.dev  # noqa: F401 -- chooses the quicker keccak
from mesh.chain.answers import explain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from web3.providers import BaseProvider
    from web3.types import RPCEndpoint

MNEMONIC: Final = "test test test test test test test test test test test junk"
PEOPLE: Final = 10
FUNDS_WEI: Final = 10**24


class Chain:
    """A chain whose accounts are unlocked, with the methods of a development node: mining on demand and snapshots."""

    def __init__(self, provider: BaseProvider, keys: Sequence[bytes]) -> None:
        # Without those that ask the node for the chain and the latest block before each transaction.
        self.web3 = Web3(provider, middleware=[(AttributeDictMiddleware, "attrdict")])
        self.keys = tuple(keys)

    def mine(self, blocks: int) -> None:
        """Let that many empty blocks pass."""
        for _ in range(blocks):
            self._request("evm_mine", [])

    def refusal(self, call: Any, sender: str) -> tuple[Any, ...]:
        """Name and arguments of the custom error with which a call in the next block reverts; empty if it does not."""
        try:
            call.call({"from": sender, "gas": 8_000_000}, block_identifier="pending")
        except TransactionFailed as failure:
            # eth-tester gives the revert data as the text of a Python literal.
            data = literal_eval(str(failure).removeprefix("execution reverted: "))
        except ContractLogicError as failure:
            data = bytes.fromhex(str(failure.data).removeprefix("0x"))
        else:
            return ()
        reverted = explain(data)
        return (reverted.reason, *reverted.arguments)

    def snapshot(self) -> Any:
        """A mark to go back to, once."""
        return self._request("evm_snapshot", [])

    def revert(self, snapshot: Any) -> None:
        """Go back to a mark."""
        self._request("evm_revert", [snapshot])

    def _request(self, method: str, params: list[Any]) -> Any:
        provider = self.web3.provider
        response = provider.make_request(_endpoint(method), params)
        if "error" in response:
            raise Web3RPCError(f"{method}: {response}")
        return response["result"]


def py_evm() -> Chain:
    """A new chain in this process, in the fork that eth-tester chooses, with a block for each transaction."""
    backend = PyEVMBackend.from_mnemonic(
        MNEMONIC,
        genesis_state_overrides={"balance": FUNDS_WEI},
        num_accounts=PEOPLE,
        hd_path="m/44'/60'/0'/0",
        genesis_parameters=PyEVMBackend.generate_genesis_params({"gas_limit": 30_000_000}),
    )
    return Chain(EthereumTesterProvider(EthereumTester(backend)), [key.to_bytes() for key in backend.account_keys])


def remote(url: str, keys: Sequence[bytes]) -> Chain:
    """A development node behind JSON-RPC."""
    session = requests.Session()
    session.trust_env = False  # it would look for proxies in the environment before each request
    return Chain(HTTPProvider(url, session=session), keys)


def _endpoint(method: str) -> RPCEndpoint:
    return method  # type: ignore[return-value]
