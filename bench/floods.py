"""What attackers without money do to a market: each flood is a coroutine, which `bench/flood.py` runs by its name.

A flood prepares what it sends, waits at `Attacker.begin`, and then attacks until it is cancelled, or returns when it
has done all. An attacker has a session at the market's router, and no account.
"""

from __future__ import annotations

import asyncio
import itertools
import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import zenoh
from msgspec.structs import replace

from mesh.network import message_key
from schemas import ZERO_ADDRESS, Demand, Offer, PresenceKey, Result, RpcKey, Signer, Withdrawal, cid_of_digest, encode
from schemas.address import checksum_address
from schemas.keys import market_selector

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable

    Flood = Callable[["Attacker"], Coroutine[Any, Any, None]]

PREPARED: Final = 10_000
"""Messages that a flood prepares; it sends them again and again."""
SLOWLY: Final = 0.1
"""Seconds between the messages of a flood that takes its time."""
BURST: Final = 64
"""Messages that are put between two turns of the event loop."""
TOKENS: Final = 50_000
"""Liveliness tokens of one flood."""
LIES: Final = 65
"""Lies that a content liar sends for each query."""
QUERIES: Final = 256
"""Queries of a flood that are open at a time."""


@dataclass(kw_only=True)
class Attacker:
    """What an attacker knows of the market, and its session."""

    session: zenoh.Session
    lighthouse: str
    """The ENS name of the market."""
    address: str
    """The lighthouse's address."""
    xrt: str
    model: str
    """The model that the robot serves."""
    objective: str
    """The CID of an objective that the honest person has."""
    deadline: int
    """A block that is near enough for a valid order."""
    robot: str
    """The robot's address."""
    begin: Callable[[], Awaitable[None]]
    """Report that everything is prepared, and wait for the beginning of the attack."""

    def demand(self, **changes: Any) -> Demand:
        """An unsigned demand that is valid on this market, for an objective that nobody has."""
        fields: dict[str, Any] = {
            "model": self.model,
            "objective": cid_of_digest(secrets.token_bytes(32)),
            "token": self.xrt,
            "cost": 1,
            "lighthouse": self.address,
            "validator": ZERO_ADDRESS,
            "validator_fee": 0,
            "deadline": self.deadline,
            "nonce": secrets.token_hex(32),
        }
        return Demand(**(fields | changes))

    def put(self, message: Demand | Offer | Result) -> None:
        """Publish a message on its key."""
        self.session.put(message_key(self.lighthouse, message), encode(message))

    async def put_all(self, wire: Iterable[tuple[str, bytes]]) -> None:
        """Put payloads on keys as fast as this process can."""
        for number, (key, payload) in enumerate(wire):
            self.session.put(key, payload)
            if number % BURST == 0:
                await asyncio.sleep(0)

    async def put_again_and_again(self, wire: list[tuple[str, bytes]]) -> None:
        """The same, without end."""
        await self.begin()
        await self.put_all(itertools.cycle(wire))

    def wire(self, messages: Iterable[Demand | Offer | Result | Withdrawal]) -> list[tuple[str, bytes]]:
        """Keys and payloads of messages."""
        return [(message_key(self.lighthouse, message), encode(message)) for message in messages]


FLOODS: Final[dict[str, Flood]] = {}
"""The floods by their names."""


def flood(function: Flood) -> Flood:
    """Register a flood under its name, with dashes."""
    FLOODS[function.__name__.replace("_", "-")] = function
    return function


def sign(message: Any) -> Any:
    """The message, signed by an account that nobody has seen before."""
    return Signer(secrets.token_bytes(32)).sign(message)


@flood
async def dead_objectives(attacker: Attacker) -> None:
    """Valid demands of fresh keys for objectives that nobody has: 10 a second for a while, then all at once."""
    wire = attacker.wire(sign(attacker.demand()) for _ in range(PREPARED))
    await attacker.begin()
    for number in range(100):
        await attacker.put_all([wire[number]])
        await asyncio.sleep(SLOWLY)
    await attacker.put_all(wire[100:])


@flood
async def random_signatures(attacker: Attacker) -> None:
    """Valid demands with random signatures: half of them recover some signer, at the full price of a verification."""
    order = attacker.demand()

    def one() -> Demand:
        signature = secrets.token_bytes(32) + b"\1" + secrets.token_bytes(31) + b"\x1b"
        return replace(order, nonce=secrets.token_hex(32), signature=signature.hex())

    await attacker.begin()
    await attacker.put_all(attacker.wire([one()])[0] for _ in itertools.count())


def offer_of(terms: Demand) -> Offer:
    """An unsigned offer that matches a demand."""
    shared = {name: getattr(terms, name) for name in terms.__struct_fields__ if name != "validator_fee"}
    return Offer(**shared | {"nonce": secrets.token_hex(32)}, lighthouse_fee=0)


def pairs(attacker: Attacker, cost: int) -> list[Demand | Offer]:
    """Demands and offers that match, by fresh keys."""
    demands = [attacker.demand(cost=cost) for _ in range(PREPARED // 2)]
    return [sign(message) for demand in demands for message in (demand, offer_of(demand))]


@flood
async def unfunded_pairs(attacker: Attacker) -> None:
    """Demands and offers that match, by accounts without tokens."""
    await attacker.put_again_and_again(attacker.wire(pairs(attacker, cost=1)))


@flood
async def free_pairs(attacker: Attacker) -> None:
    """Demands and offers that match and cost nothing: the provider creates their contracts, as many as it can."""
    await attacker.put_again_and_again(attacker.wire(pairs(attacker, cost=0)))


@flood
async def unknown_results(attacker: Attacker) -> None:
    """Results of fresh keys for contracts that do not exist: each would be a call of the node."""
    addresses = (checksum_address(secrets.token_bytes(20)) for _ in range(PREPARED))
    results = (Result(liability=address, result=attacker.objective, success=True) for address in addresses)
    await attacker.put_again_and_again(attacker.wire(map(sign, results)))


@flood
async def free_offers(attacker: Attacker) -> None:
    """Offers of fresh keys that cost nothing and match nothing, more than an order book holds."""
    offers = (sign(offer_of(attacker.demand())) for _ in range(4 * PREPARED))
    await attacker.put_again_and_again(attacker.wire(offers))


@flood
async def withdrawals(attacker: Attacker) -> None:
    """Withdrawals by fresh keys of orders that nobody has."""
    made = (
        Withdrawal(order=secrets.token_hex(32), lighthouse=attacker.address, deadline=attacker.deadline)
        for _ in range(PREPARED)
    )
    await attacker.put_again_and_again(attacker.wire(map(sign, made)))


@flood
async def far_deadlines(attacker: Attacker) -> None:
    """Free demands of fresh keys for an objective that the robot has, so that it offers, valid for 10^9 blocks."""
    demands = (attacker.demand(objective=attacker.objective, cost=0, deadline=10**9) for _ in range(PREPARED))
    wire = attacker.wire(sign(demand) for demand in demands)
    await attacker.begin()
    await attacker.put_all(wire)


@flood
async def duplicates(attacker: Attacker) -> None:
    """One valid demand, again and again."""
    await attacker.put_again_and_again(attacker.wire([sign(attacker.demand())]))


@flood
async def garbage(attacker: Attacker) -> None:
    """Bytes that are no messages, and messages with a wrong field, on the keys of messages."""
    ((key, payload),) = attacker.wire([sign(attacker.demand())])
    broken = [payload.replace(b'"cost":1', b'"cost":-%d' % number) for number in range(PREPARED)]
    await attacker.put_again_and_again([(key, each) for text in broken for each in (secrets.token_bytes(700), text)])


@flood
async def large(attacker: Attacker) -> None:
    """Payloads of 60 KiB on the keys of demands, offers and results."""
    terms = attacker.demand()
    keys = [market_selector(attacker.lighthouse, kind, terms.model) for kind in ("demand", "offer")]
    keys.append(
        message_key(attacker.lighthouse, Result(liability=attacker.robot, result=terms.objective, success=True))
    )
    await attacker.put_again_and_again([(key, secrets.token_bytes(60 * 1024)) for key in keys])


@flood
async def unknown_names(attacker: Attacker) -> None:
    """Demands with validators by ENS names that do not exist, each another one."""
    signature = secrets.token_hex(64) + "1b"
    orders = [attacker.demand(validator=f"{secrets.token_hex(8)}.eth", signature=signature) for _ in range(PREPARED)]
    await attacker.put_again_and_again(attacker.wire(orders))


async def query_all(attacker: Attacker, queries: Iterable[tuple[str, bytes]]) -> None:
    """Query without waiting for answers, `QUERIES` at a time."""
    loop, limit = asyncio.get_running_loop(), asyncio.Semaphore(QUERIES)

    def ignore(_: zenoh.Reply) -> None:
        pass

    def done() -> None:
        loop.call_soon_threadsafe(limit.release)

    for key, payload in queries:
        await limit.acquire()
        attacker.session.get(key, zenoh.handlers.Callback(ignore, done), payload=payload, timeout=1.0)


@flood
async def balance_queries(attacker: Attacker) -> None:
    """Calls of the robot's service for balances, each for another account: each would be a call of the node."""
    key = str(RpcKey(attacker.robot, "eth/account_xrt_balance"))
    await attacker.begin()
    await query_all(
        attacker, ((key, b'{"account":"0x%s"}' % secrets.token_hex(20).encode()) for _ in itertools.count())
    )


@flood
async def recall_queries(attacker: Attacker) -> None:
    """Queries for the whole order book, after 10,000 demands have filled it."""
    wire = attacker.wire(sign(attacker.demand()) for _ in range(PREPARED))
    await attacker.begin()
    await attacker.put_all(wire)
    await query_all(attacker, ((f"aira/{attacker.lighthouse}/**", b"") for _ in itertools.count()))


@flood
async def tokens(attacker: Attacker) -> None:
    """50,000 liveliness tokens of agents that do not exist."""
    await attacker.begin()
    liveliness, declared = attacker.session.liveliness(), []
    for _ in range(TOKENS):
        key = str(PresenceKey(attacker.lighthouse, "agent", "0x" + secrets.token_hex(20)))
        declared.append(liveliness.declare_token(key))
        if len(declared) % BURST == 0:
            await asyncio.sleep(0)
    await asyncio.Event().wait()


@flood
async def content_liars(attacker: Attacker) -> None:
    """Answer each query for a block with lies, before its holder does."""

    def lie(query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            if "/cid/" in key:
                for number in range(LIES):
                    query.reply(key.replace("*", attacker.robot), f"lie {number}")

    await attacker.begin()
    with attacker.session.declare_queryable("aira/agent/**", lie):
        await asyncio.Event().wait()
