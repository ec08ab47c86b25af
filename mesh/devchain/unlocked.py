"""The accounts that a development chain signs for: those that its first block funded.

As anvil does: the keys are public, and worth nothing elsewhere.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from eth_account import Account as EthAccount
from eth_account.messages import encode_defunct

from mesh.chain import Account
from mesh.devchain.calls import parse_call
from mesh.devchain.jsonrpc import INVALID_PARAMS, RpcError, parse_data, parse_quantity

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.devchain.evm import Evm

UNKNOWN_ACCOUNT: Final = "No Signer available"
"""Anvil's words."""


class UnlockedAccounts:
    """Signs messages and transactions. All methods raise `RpcError`, `INVALID_PARAMS` for an account of another."""

    def __init__(self, evm: Evm) -> None:
        self._evm = evm
        self._keys = {_address_of(key): key for key in evm.funded_keys}

    def methods(self) -> dict[str, Callable[..., Any]]:
        """The JSON-RPC methods that use these accounts, by name."""
        return {
            "eth_accounts": lambda: self.addresses,
            "eth_coinbase": lambda: self.addresses[0],
            "eth_sign": self.sign,
            "personal_sign": lambda text, address, _password=None: self.sign(address, text),
            "eth_sendTransaction": self.send,
        }

    @property
    def addresses(self) -> list[bytes]:
        """In the order in which they were derived."""
        return list(self._keys)

    def sign(self, address: object, text: object) -> bytes:
        """The signature of a personal message (65 bytes, v = 27 or 28)."""
        key = self._key(address)
        return bytes(EthAccount.sign_message(encode_defunct(parse_data(text)), key).signature)

    def send(self, call: dict[str, Any]) -> bytes:
        """Sign a transaction, mine it, and return its hash.

        What it leaves out is filled in: the nonce, the fees, and the gas by an estimate.
        """
        fields = parse_call(call)
        key = self._key(call.get("from"))
        transaction: dict[str, Any] = {
            "chainId": self._evm.chain_id,
            "nonce": self._evm.nonce(fields["from"], self._evm.head),
            "to": fields.get("to", b""),
            "value": fields.get("value", 0),
            "data": fields["data"],
        }
        if call.get("nonce") is not None:
            transaction["nonce"] = parse_quantity(call["nonce"])
        transaction |= self._fees(call)
        transaction["gas"] = fields["gas"] if "gas" in fields else self._evm.calls.estimate(fields, self._evm.head)
        return self._evm.send(Account.from_key(key).sign_transaction(transaction).raw)

    def _fees(self, call: dict[str, Any]) -> dict[str, int]:
        """The fees of a transaction as its sender gave them, or such that it is mined."""
        if call.get("gasPrice") is not None:
            return {"gasPrice": parse_quantity(call["gasPrice"])}
        tip = parse_quantity(call.get("maxPriorityFeePerGas") or 0)
        most = parse_quantity(call.get("maxFeePerGas") or 2 * self._evm.base_fee + tip)
        return {"maxFeePerGas": most, "maxPriorityFeePerGas": tip}

    def _key(self, address: object) -> bytes:
        key = self._keys.get(parse_data(address, length=20))
        if key is None:
            raise RpcError(INVALID_PARAMS, UNKNOWN_ACCOUNT)
        return key


def _address_of(key: bytes) -> bytes:
    return bytes.fromhex(Account.from_key(key).address[2:])
