"""People and robots of 2018: an Ethereum key, JSON, and PubSub through their own IPFS daemon. Nothing of the mesh."""

from __future__ import annotations

import asyncio
import json
import secrets
from typing import Any

from eth_abi.packed import encode_packed
from eth_account import Account
from eth_account.messages import encode_defunct
from eth_utils.crypto import keccak

from tests.bridges.ipfs.legacy import Bare

ALPHABET = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz"
NOBODY = "0x" + "0" * 40
SECONDS = 60.0
ADDED = (("cid-version", "0"), ("raw-leaves", "false"), ("chunker", "size-262144"), ("hash", "sha2-256"))


def multihash(name: str) -> bytes:
    """The 34 bytes behind a CIDv0."""
    number = 0
    for digit in name:
        number = number * 58 + ALPHABET.index(digit)
    return number.to_bytes(34, "big")


class Veteran(Bare):
    """One of them, at the daemon whose RPC is at `api`, on the channel `topic`, with a private key."""

    def __init__(self, api: str, topic: str, key: bytes) -> None:
        super().__init__(api)
        self._topic = topic
        self._account = Account.from_key(key)
        self.address: str = self._account.address

    def demand(self, **terms: Any) -> dict[str, Any]:
        """A signed demand."""
        return self._order("validatorFee", terms)

    def offer(self, asked: dict[str, Any]) -> dict[str, Any]:
        """A signed offer to do what a demand asks for."""
        terms = {name: asked[name] for name in ("model", "objective", "token", "cost", "lighthouse", "deadline")}
        return self._order("lighthouseFee", terms)

    def result(self, liability: str, name: str) -> dict[str, Any]:
        """A signed result."""
        hashed = keccak(encode_packed(["address", "bytes", "bool"], [liability, multihash(name), True]))
        return {"liability": liability, "result": name, "success": True, "signature": self._sign(hashed)}

    async def say(self, message: dict[str, Any]) -> None:
        """Put a message on the channel."""
        await self.publish(self._topic, json.dumps(message, separators=(",", ":")).encode())

    async def hear(self, field: str, **terms: Any) -> dict[str, Any]:
        """The first message heard that has this field and these terms."""
        async with asyncio.timeout(SECONDS):
            while True:
                for data in self.heard:
                    message: dict[str, Any] = json.loads(data)
                    if field in message and terms.items() <= message.items():
                        return message
                await asyncio.sleep(0.05)

    async def add(self, content: bytes) -> str:
        """Add a file to IPFS."""
        name: str = (await self.call("add", *ADDED, content=content))["Hash"]
        return name

    def _order(self, fee: str, terms: dict[str, Any]) -> dict[str, Any]:
        order = terms | {"validator": NOBODY, fee: 0, "nonce": secrets.token_hex(32)}
        # An offer is hashed with the two the other way round.
        first, second = ("lighthouse", "validator") if fee == "validatorFee" else ("validator", "lighthouse")
        packed = encode_packed(
            ["bytes", "bytes", "address", "uint256", "address", "address", "uint256", "uint256", "bytes32"],
            [
                multihash(order["model"]),
                multihash(order["objective"]),
                order["token"],
                order["cost"],
                order[first],
                order[second],
                order[fee],
                order["deadline"],
                bytes.fromhex(order["nonce"]),
            ],
        )
        return order | {"signature": self._sign(keccak(packed))}

    def _sign(self, hashed: bytes) -> str:
        signature: str = self._account.sign_message(encode_defunct(hashed)).signature.hex()
        return signature.removeprefix("0x")
