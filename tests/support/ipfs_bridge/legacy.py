"""Clients of the legacy network: an Ethereum key, JSON, and PubSub through an IPFS daemon's RPC.

They use none of this project's code.
"""

from __future__ import annotations

import asyncio
import json
import secrets
from base64 import urlsafe_b64decode, urlsafe_b64encode
from typing import TYPE_CHECKING, Any, Self

import aiohttp
from eth_abi.packed import encode_packed
from eth_account import Account
from eth_account.messages import encode_defunct
from eth_utils.crypto import keccak

if TYPE_CHECKING:
    from types import TracebackType


def multibase(data: bytes) -> str:
    """Bytes as current daemons write them."""
    return "u" + urlsafe_b64encode(data).decode().rstrip("=")


LONGEST_CALL = aiohttp.ClientTimeout(total=120)
"""A daemon looks for content without end: a test fails sooner, and says where."""


class LegacyClient:
    """A client of the daemon whose RPC is at `api`. `heard` are the messages received since `listen` returned.

    It waits `pause` seconds after each message, because a Kubo validates messages concurrently and drops one that it
    validates after a later message of the same node.
    """

    def __init__(self, api: str, *, pause: float = 0.02) -> None:
        self._api = api
        self._pause = pause
        self.heard: list[bytes] = []
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._http = aiohttp.ClientSession(timeout=LONGEST_CALL)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)
        await self._http.close()

    async def call(self, name: str, *arguments: tuple[str, str], content: bytes | None = None) -> Any:
        """Make a call that returns a JSON object, or nothing."""
        form = None
        if content is not None:
            form = aiohttp.FormData()
            form.add_field("file", content, filename="f", content_type="application/octet-stream")
        async with self._http.post(f"{self._api}/api/v0/{name}", params=arguments, data=form) as answer:
            text = await answer.text()
            assert answer.status == 200, f"{name}: {answer.status} {text}"
            return json.loads(text) if text else None

    async def listen(self, topic: str) -> None:
        """Receive the messages on `topic` from now on."""
        forever = aiohttp.ClientTimeout(total=None)
        arguments = {"arg": multibase(topic.encode())}
        answer = await self._http.post(f"{self._api}/api/v0/pubsub/sub", params=arguments, timeout=forever)
        self._tasks.append(asyncio.create_task(self._hear(answer), name=f"listen to {topic}"))

    async def publish(self, topic: str, data: bytes) -> None:
        """Publish `data` on `topic`; retry while a Kubo drops it because it validated a later message first."""
        while True:
            try:
                await self.call("pubsub/pub", ("arg", multibase(topic.encode())), content=data)
            except AssertionError as refused:
                if "validation ignored" not in str(refused):
                    raise
            else:
                await asyncio.sleep(self._pause)
                return

    async def peers(self, topic: str) -> list[str]:
        """The other nodes on `topic` that the daemon knows."""
        found: list[str] = (await self.call("pubsub/peers", ("arg", multibase(topic.encode()))))["Strings"] or []
        return found

    async def cat(self, name: str) -> bytes:
        """The file with that CID."""
        async with self._http.post(f"{self._api}/api/v0/cat", params={"arg": name}) as answer:
            assert answer.status == 200, await answer.text()
            return await answer.read()

    async def _hear(self, answer: aiohttp.ClientResponse) -> None:
        async with answer:
            async for line in answer.content:
                data = json.loads(line).get("data")
                if data is not None:
                    self.heard.append(urlsafe_b64decode(data[1:] + "=" * (-len(data[1:]) % 4)))


ALPHABET = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz"
NOBODY = "0x" + "0" * 40
SECONDS = 60.0
ADDED = (("cid-version", "0"), ("raw-leaves", "false"), ("chunker", "size-262144"), ("hash", "sha2-256"))


def multihash(name: str) -> bytes:
    """The 34 bytes of a CIDv0."""
    number = 0
    for digit in name:
        number = number * 58 + ALPHABET.index(digit)
    return number.to_bytes(34, "big")


class LegacyTrader(LegacyClient):
    """A promisee, robot or provider at the daemon whose RPC is at `api`, on `topic`, with a private key."""

    def __init__(self, api: str, topic: str, key: bytes) -> None:
        super().__init__(api)
        self._topic = topic
        self._account = Account.from_key(key)
        self.address: str = self._account.address

    def demand(self, **terms: Any) -> dict[str, Any]:
        """A signed demand."""
        return self._order("validatorFee", terms)

    def offer(self, asked: dict[str, Any]) -> dict[str, Any]:
        """A signed offer that matches a demand."""
        terms = {name: asked[name] for name in ("model", "objective", "token", "cost", "lighthouse", "deadline")}
        return self._order("lighthouseFee", terms)

    def result(self, liability: str, name: str) -> dict[str, Any]:
        """A signed result."""
        hashed = keccak(encode_packed(["address", "bytes", "bool"], [liability, multihash(name), True]))
        return {"liability": liability, "result": name, "success": True, "signature": self._sign(hashed)}

    async def send(self, message: dict[str, Any]) -> None:
        """Publish a message on the channel."""
        await self.publish(self._topic, json.dumps(message, separators=(",", ":")).encode())

    async def receive(self, field: str, **terms: Any) -> dict[str, Any]:
        """The first message received with this field and these terms."""
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
        # An offer is hashed with these two swapped.
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
