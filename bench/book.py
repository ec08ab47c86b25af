"""Orders per second that the book processes with a thousand and with a million open orders, and memory per order.

All open orders differ in their terms. Each measured pair is a demand that is added and an offer that matches it, so the
book keeps its size. For comparison, `bare` does as many inserts into and removals from one Python dictionary.
"""

from __future__ import annotations

import gc
import secrets
import time
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from common import ADDRESS, arguments, show, unsigned_demands
from mesh.market import Added, Match, OrderBook
from schemas import Demand, Offer, Verified, checksum_address, decode, encode

ROUNDS: Final = 100_000
"""Measured pairs of a demand and an offer."""


def verified_demands(count: int) -> list[Verified[Demand]]:
    """Demands as a channel yields them: decoded from JSON, with hash and signer (made up here, for speed)."""
    signature = "11" * 64 + "1b"
    people = [checksum_address(secrets.token_bytes(20)) for _ in range(16)]
    orders = []
    for number, demand in enumerate(unsigned_demands(count, deadline=0)):
        order = replace(
            demand, deadline=1000 + number % 10_000, signature=signature[:-34] + secrets.token_hex(16) + "1b"
        )
        message = decode(encode(order))
        assert isinstance(message, Demand)
        orders.append(Verified(message, secrets.token_bytes(32), people[number % 16]))
    return orders


def offer_for(demand: Verified[Demand]) -> Verified[Offer]:
    """An offer that matches a demand."""
    message = demand.message
    fields = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline", "nonce", "signature")
    offer = Offer(**{field: getattr(message, field) for field in fields}, lighthouse_fee=0)
    return Verified(offer, secrets.token_bytes(32), demand.signer)


def resident() -> int:
    """Resident bytes of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def fill(count: int) -> tuple[OrderBook, float]:
    """A book with that many open orders, and the bytes per order, including its text."""
    book = OrderBook(ADDRESS, limit=count + 10)
    gc.collect()
    before = resident()
    for start in range(0, count, 10_000):
        for order in verified_demands(min(10_000, count - start)):
            assert isinstance(book.add(order), Added)
    gc.collect()
    return book, (resident() - before) / count


def orders_per_second(book: OrderBook, pairs: list[tuple[Verified[Demand], Verified[Offer]]]) -> float:
    """Orders per second while the book keeps its size."""
    started = time.perf_counter()
    for demand, offer in pairs:
        book.add(demand)
        match = book.add(offer)
    seconds = time.perf_counter() - started
    assert isinstance(match, Match)
    return 2 * len(pairs) / seconds


def bare_per_second(pairs: list[tuple[Verified[Demand], Verified[Offer]]]) -> float:
    """Orders per second into and out of one dictionary, by their hash."""
    entries: dict[bytes, object] = {}
    started = time.perf_counter()
    for demand, offer in pairs:
        entries[demand.hash] = demand
        entries[offer.hash] = offer
        del entries[demand.hash], entries[offer.hash]
    return 2 * len(pairs) / (time.perf_counter() - started)


def main() -> None:
    """Run the benchmark."""
    options = arguments("orders per second through the book", small=1000, large=1_000_000)
    pairs = [(demand, offer_for(demand)) for demand in verified_demands(ROUNDS)]
    small, _ = fill(options.small)
    at_small = max(orders_per_second(small, pairs) for _ in range(3))
    large, bytes_per_order = fill(options.large)
    at_large = max(orders_per_second(large, pairs) for _ in range(3))
    results = {
        "orders_per_second": round(at_large),
        "orders_per_second_small": round(at_small),
        "bare_per_second": round(bare_per_second(pairs)),
        "ratio": round(at_large / at_small, 3),
        "bytes_per_order": round(bytes_per_order),
    }
    show(results, as_json=options.json)


if __name__ == "__main__":
    main()
