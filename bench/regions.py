"""A million agents in a hundred regions, simulated: the state of the core, and how long a match takes.

The design is that of `docs/explanation/scale.md`. Each region is a Zenoh network of its own with a gateway process,
which has one session in the region and one in the core, where it declares one subscription, one queryable and one
token. Models are spread over the regions by hash; a model's market, with its order book, is in its home region, where
its robots connect. Robots renew a lease in the book instead of declaring a token. A demand travels from its person's
region through the core to the home region; the offer that answers it stays there.

Keys and messages are real: their lengths are those of this package's encodings. Times of routers and books are
measured by `bench/scale.py` and `bench/messages.py`; delays of the network are assumed. Every router, gateway and book
is a queue with one server, in a simulation of discrete events. The bars: a match within 250 ms for 99 %, and state in
the core in proportion to the regions.
"""

from __future__ import annotations

import heapq
import random
import sys
from argparse import ArgumentParser
from itertools import count
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from common import LIGHTHOUSE, show, signed_demands
from mesh.network import message_key
from schemas import Offer, PresenceKey, Signer, encode, lighthouse_selector

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ROUTER: Final = 45e-6
"""Seconds of a router for a message: one small message in and out, at 600 sessions (`bench/scale.py`)."""
SIBLING: Final = 0.65e-6
"""Seconds of a router for each declared sibling of a key to which nobody has subscribed (`bench/scale.py`)."""
BOOK: Final = 150e-6
"""Seconds of a book for a message: decoding, signature and match (`bench/messages.py`, `bench/book.py`)."""
GATEWAY: Final = 60e-6
"""Seconds of a gateway for a message that it passes on unread: the pump without validation."""
ROBOT: Final = 0.005
"""Seconds of a robot from a demand to its signed offer."""
ACCESS: Final = (0.002, 0.030)
"""Seconds between a client and its router, uniform."""
DISTANCE: Final = (0.010, 0.080)
"""Seconds between two regions, uniform for each pair and the same both ways."""
FAR: Final = 0.2
"""The share of robots that are not near their model's home region."""
LEASE: Final = 60.0
"""Seconds between two renewals of a robot's lease."""
FRAME: Final = 12
"""Bytes that Zenoh adds to a key and a payload."""
ROUTER_KIB: Final = 40.0
"""Memory of a router for an agent's session, KiB."""
ENTRIES_OF_GATEWAY: Final = 3
ENTRIES_OF_AGENT: Final = 4
"""What an agent declares: its model's demands, rejections of its orders, its services (one wildcard), its token."""
BAR_MS: Final = 250.0


class Plan(NamedTuple):
    """The size of the network. `rate` is in demands per second."""

    agents: int
    regions: int
    models: int
    rate: float
    cores: int
    routers: int
    """Routers of a region; its agents are spread over them."""


class Clock:
    """Events in the order of their times."""

    def __init__(self) -> None:
        self.now = 0.0
        self._numbers = count()
        self._events: list[tuple[float, int, Callable[[], None]]] = []

    def at(self, when: float, event: Callable[[], None]) -> None:
        """Call `event` at that time."""
        heapq.heappush(self._events, (when, next(self._numbers), event))

    def run(self) -> None:
        """Until there are no more events."""
        while self._events:
            self.now, _, event = heapq.heappop(self._events)
            event()


class Server:
    """A queue with one server: a router, a gateway, a book."""

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock = clock
        self._seconds = seconds
        self._free = 0.0
        self.busy = 0.0

    def serve(self, then: Callable[[], None], *, delay: float = 0.0) -> None:
        """Take a message, and call `then` `delay` seconds after it is served."""
        self._free = max(self._free, self._clock.now) + self._seconds
        self.busy += self._seconds
        self._clock.at(self._free + delay, then)


class Network:
    """The servers of all regions and of the core, and the way of an order through them."""

    def __init__(self, plan: Plan, chance: random.Random) -> None:
        self.plan, self.clock, self._random = plan, Clock(), chance
        self.regions = [[Server(self.clock, ROUTER) for _ in range(plan.routers)] for _ in range(plan.regions)]
        self.gateways = [Server(self.clock, GATEWAY) for _ in range(plan.regions)]
        self.books = [Server(self.clock, BOOK) for _ in range(plan.regions)]
        self.core = [Server(self.clock, ROUTER) for _ in range(plan.cores)]
        self.matches: list[float] = []
        self.core_messages = 0

    def demand(self) -> None:
        """A person anywhere sends a demand for a model; record how long the match takes."""
        started = self.clock.now
        here, home = self._random.randrange(self.plan.regions), self._random.randrange(self.plan.regions)
        steps = [*self._access(here)]
        if here != home:
            apart, self.core_messages = self._apart(here, home), self.core_messages + 1
            core = self.core[here % self.plan.cores]
            steps += [(self.gateways[here], apart / 2), (core, apart / 2), (self.gateways[home], 0.0)]
        is_far = self._random.random() < FAR
        away = self._random.uniform(*DISTANCE) if is_far else self._random.uniform(*ACCESS)
        steps += [(self._router(home), away), (None, ROBOT + away), (self._router(home), 0.0), (self.books[home], 0.0)]
        self._walk(iter(steps), lambda: self.matches.append(self.clock.now - started))
        # The book receives the demand, too.
        self.books[home].serve(lambda: None)

    def renew(self, region: int) -> None:
        """A robot renews its lease."""
        self._walk(iter([*self._access(region), (self.books[region], 0.0)]), lambda: None)

    def _access(self, region: int) -> list[tuple[Server | None, float]]:
        return [(None, self._random.uniform(*ACCESS)), (self._router(region), 0.0)]

    def _router(self, region: int) -> Server:
        return self._random.choice(self.regions[region])

    def _apart(self, one: int, other: int) -> float:
        pair = random.Random(f"{min(one, other)} {max(one, other)}")
        return pair.uniform(*DISTANCE)

    def _walk(self, steps: Iterator[tuple[Server | None, float]], end: Callable[[], None]) -> None:
        """Pass the servers one after the other; each step has a delay after it."""
        step = next(steps, None)
        if step is None:
            end()
            return
        server, delay = step

        def on() -> None:
            self._walk(steps, end)

        if server is None:
            self.clock.at(self.clock.now + delay, on)
        else:
            server.serve(on, delay=delay)


def simulate(plan: Plan, seconds: float, seed: int) -> dict[str, Any]:
    """The matches of that many seconds, and how busy the servers were."""
    chance = random.Random(seed)
    network, clock = Network(plan, chance), 0.0
    while (clock := clock + chance.expovariate(plan.rate)) < seconds:
        network.clock.at(clock, network.demand)
    leases = plan.agents / LEASE
    clock = 0.0
    while (clock := clock + chance.expovariate(leases)) < seconds:
        network.clock.at(clock, lambda: network.renew(chance.randrange(plan.regions)))
    network.clock.run()
    taken = sorted(network.matches)
    routers = [server for region in network.regions for server in region]
    return {
        "matches": len(taken),
        "p50_ms": round(taken[len(taken) // 2] * 1e3, 1),
        "p99_ms": round(taken[len(taken) * 99 // 100] * 1e3, 1),
        "core_messages_per_s": round(network.core_messages / seconds),
        "busy_percent": {
            name: round(max(server.busy for server in servers) / seconds * 100, 1)
            for name, servers in (
                ("core router", network.core),
                ("region router", routers),
                ("gateway", network.gateways),
                ("book", network.books),
            )
        },
    }


def state(plan: Plan) -> dict[str, Any]:
    """What routers hold: declarations in the core with one aggregate a region and without, and in a region."""
    of_region = plan.agents // plan.regions
    return {
        "core_entries": plan.regions * ENTRIES_OF_GATEWAY,
        "core_entries_without_aggregates": plan.models + plan.agents * (ENTRIES_OF_AGENT - 1),
        "region_entries": of_region * ENTRIES_OF_AGENT,
        "region_router_mib": round(of_region / plan.routers * ROUTER_KIB / 1024),
        "unknown_model_us": round(plan.models / plan.regions * SIBLING * 1e6, 1),
    }


def sizes() -> dict[str, int]:
    """Bytes on the wire, with key and framing."""
    (demand,) = signed_demands(1)
    fields = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline", "nonce")
    terms = {field: getattr(demand, field) for field in fields}
    offer = Signer(b"\1" * 32).sign(Offer(**terms, lighthouse_fee=0))
    lease = str(PresenceKey(LIGHTHOUSE, "agent", demand.lighthouse))
    return {
        "demand_bytes": len(message_key(LIGHTHOUSE, demand)) + len(encode(demand)) + FRAME,
        "offer_bytes": len(message_key(LIGHTHOUSE, offer)) + len(encode(offer)) + FRAME,
        "lease_bytes": len(lease) + 65 + 8 + FRAME,
        "aggregate_bytes": len(lighthouse_selector(LIGHTHOUSE)) + FRAME,
    }


def main() -> None:
    """Run the simulation."""
    parser = ArgumentParser(description="a million agents in a hundred regions, simulated")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    for name, default in (
        ("agents", 1_000_000),
        ("regions", 100),
        ("models", 100_000),
        ("rate", 2_000),
        ("cores", 3),
        ("routers", 4),
        ("seconds", 10),
        ("seed", 1),
    ):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    plan = Plan(*(getattr(options, field) for field in Plan._fields))
    results: dict[str, Any] = plan._asdict() | state(plan) | simulate(plan, options.seconds, options.seed) | sizes()
    results["core_mbit_per_s"] = round(results["core_messages_per_s"] * results["demand_bytes"] * 8 / 1e6, 1)
    of_ten_times = state(plan._replace(agents=plan.agents * 10))["core_entries"]
    bars = {
        f"99 % of matches take {results['p99_ms']} ms": results["p99_ms"] <= BAR_MS,
        "the core's state grows with the agents": of_ten_times == results["core_entries"],
        "a server is overloaded": max(results["busy_percent"].values()) < 80,
    }
    results["missed"] = [bar for bar, is_met in bars.items() if not is_met]
    show(results, as_json=options.json)
    sys.exit(bool(results["missed"]))


if __name__ == "__main__":
    main()
