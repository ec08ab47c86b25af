"""The robots that are present on a lighthouse's channel: their profiles, their names, their addresses by name, and
their quotes: what they want for a job, and when they would do it. Quotes bind nobody, and cost nothing.

A name is its owner's word, and anybody may choose any. So a name stands beside the address, and resolves to one only
while no other robot that is present has it.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from mesh.base.flood import BoundedDict, Rate, RateLimiter
from mesh.errors import InputError
from mesh.watching.market import QUERY_LIMITS, query_all, signed_answers
from mesh.watching.presence import PEER_LIMITS, present
from schemas import InvalidRecord, ProfileKey, RpcKey, parse_address
from schemas.address import shortened
from schemas.profiles import PROFILE_LIMITS, Profile, ProfileState
from schemas.rpc import Quote, QuoteRequest

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    import zenoh

    from mesh.chain import Chain
    from mesh.network import Channel
    from schemas.signing import Signer


class ProfileLookupLimits(NamedTuple):
    """How often robots are asked for their profiles, and for how long these are kept."""

    rate: Rate = Rate(per_second=20.0, burst=200)
    """Robots that are asked for their names."""
    timeout: float = 0.5
    """Seconds that a robot has to say its name."""
    rest: float = 10.0
    """How many times as long as a robot was silent no other is asked: strangers who are silent may take a tenth of the
    time."""
    kept: float = 60.0
    """Seconds for which the profile of a robot is not asked for again, …"""
    kept_silence: float = 5.0
    """… and that of one that has none."""
    robots: int = 1024
    """Robots whose profiles are kept."""


PROFILE_LOOKUP_LIMITS: Final = ProfileLookupLimits()


class Robot(msgspec.Struct, frozen=True, kw_only=True):
    """A robot that is present, as it presents itself; `str(robot)` is its name, or its short address."""

    address: str
    """EIP-55."""
    model: str
    """A CIDv0; empty if it has none."""
    name: str
    """What its owner calls it; anybody may choose the same."""
    about: str
    """One sentence, plain text; may be empty."""
    picture: str
    """The CID of an image, or empty."""
    place: str
    """Where it says that it is; may be empty."""
    price: str
    """What a job usually costs, as `5 XRT`; may be empty."""
    state: ProfileState
    """`idle`, `working`, `stopped` by somebody, or `closed`: it takes no jobs now."""
    queue: int
    """Jobs that wait."""
    wait: int
    """Seconds after which a new job would begin, estimated."""
    readings: dict[str, str]
    """What it reads just now: the latest text that it has published on each topic outside of jobs, four at most."""
    time: int
    """When it said this, by its clock: Unix seconds."""
    formerly: tuple[str, ...] = ()
    """Its earlier addresses, latest first, whose keys have signed that it goes on under this one."""
    paid: int | None = None
    """Contracts that paid it, of the 500 latest on the chain of a week; None if this side did not count them."""
    refunded: int | None = None
    """Contracts that were refunded, in the same way."""

    def __str__(self) -> str:
        return self.name or shortened(self.address)


def robot_of(profile: Profile) -> Robot:
    """The robot that a profile presents."""
    facts = msgspec.structs.asdict(profile)
    shown = {name: facts[name] for name in facts if name not in ("agent", "handovers", "signature")}
    return Robot(address=profile.agent, formerly=profile.predecessors, **shown)


def accounts_of(robots: Collection[Robot]) -> dict[str, list[str]]:
    """By address of each robot, the accounts whose jobs count as its own.

    These are its address and its earlier ones, but none at which another one of `robots` is or was.
    """
    claims = Counter(address for robot in robots for address in (robot.address, *robot.formerly))
    return {
        robot.address: [robot.address, *(address for address in robot.formerly if claims[address] == 1)]
        for robot in robots
    }


def labelled(address: str, name: str) -> str:
    """A robot for people: its name with the short address, or the full address if it has no name."""
    return f"{name} ({shortened(address)})" if name else address


class RobotDirectory:
    """Asks robots for their profiles: `await directory.find(address)`. What they say is kept for a minute."""

    def __init__(self, session: zenoh.Session, channel: Channel) -> None:
        self._session = session
        self._channel = channel
        self._known: BoundedDict[str, tuple[Profile | None, float]] = BoundedDict(PROFILE_LOOKUP_LIMITS.robots)
        self._outcomes: tuple[Mapping[str, tuple[int, int]], float] = ({}, 0.0)
        self._limiter = RateLimiter(per_sender=PROFILE_LOOKUP_LIMITS.rate)
        self._rests_until = 0.0

    async def present(self, model: str = "", *, timeout: float = QUERY_LIMITS.timeout) -> list[Robot]:
        """The robots that are present on the channel, or those of a model (CID): by name, then by address.

        They are asked now, for `timeout` seconds each and `PEER_LIMITS.patience` in all. Who does not answer is not
        listed.
        """
        asked = [peer.address for peer in await present(self._channel, "agent")]
        until, found = time.monotonic() + PEER_LIMITS.patience, dict[str, Profile]()
        for start in range(0, len(asked), PEER_LIMITS.batch):
            if time.monotonic() > until:
                break
            found |= await self._ask(asked[start : start + PEER_LIMITS.batch], timeout)
        for address, profile in found.items():
            self._known[address] = profile, time.monotonic() + PROFILE_LOOKUP_LIMITS.kept
        robots = [robot_of(profile) for profile in found.values() if model in ("", profile.model)]
        return sorted(robots, key=lambda robot: (not robot.name, robot.name.casefold(), robot.address))

    async def count(self, chain: Chain, robots: Iterable[Robot]) -> list[Robot]:
        """The same robots, with how the chain's latest contracts ended; what the chain says is kept for a minute.

        Those of earlier addresses count, too, unless another one of `robots` is or was at that address.
        Raises `ChainError`.
        """
        outcomes, until = self._outcomes
        if time.monotonic() >= until:
            # A week, where a block takes 12 seconds.
            outcomes = await chain.liabilities.outcomes(blocks=50_000, most=500)
            self._outcomes = outcomes, time.monotonic() + PROFILE_LOOKUP_LIMITS.kept
        known, counted = list(robots), []
        accounts = accounts_of(known)
        for robot in known:
            ends = [outcomes.get(address, (0, 0)) for address in accounts[robot.address]]
            paid, refunded = (sum(numbers) for numbers in zip(*ends, strict=True))
            counted.append(msgspec.structs.replace(robot, paid=paid, refunded=refunded))
        return counted

    async def find(self, address: str) -> Profile | None:
        """The profile of the robot at an address (EIP-55); None if it has none, or if too many were asked for."""
        profile, until = self._known.get(address, (None, 0.0))
        now = time.monotonic()
        if now < until or now < self._rests_until or not self._limiter.allow(""):
            return profile
        limits = PROFILE_LOOKUP_LIMITS
        profile = (await self._ask([address], limits.timeout)).get(address)
        self._known[address] = profile, time.monotonic() + (limits.kept_silence if profile is None else limits.kept)
        if profile is None and (silent := time.monotonic() - now) >= limits.timeout:
            self._rests_until = now + silent * (1 + limits.rest)
        return profile

    async def named(self, text: str, *, model: str = "", timeout: float = QUERY_LIMITS.timeout) -> Robot:
        """The robot that is present with that name or address, of the `model` (CID) if one is given.

        Upper and lower case are the same. Raises `InputError`: `robot-unknown` if none has this name or address,
        `robot-ambiguous` if several have it; `InvalidAddress`.
        """
        if text[:2].lower() == "0x":
            profile = await self.find(parse_address(text))
            if profile is None:
                raise InputError(
                    f"the robot {text} does not say what it is",
                    hint="`aira robots` lists those that do",
                    code="robot-unknown",
                )
            return robot_of(profile)
        robots = await self.present(model, timeout=timeout)
        found = [robot for robot in robots if robot.name.casefold() == text.strip().casefold()] if text.strip() else []
        if len(found) == 1:
            return found[0]
        shown = [f"{robot.name or 'without a name'} {robot.address}" for robot in (found or robots)[:10]]
        if found:
            raise InputError(
                f"{len(found)} robots are called {text[:80]!r}: {', '.join(shown)}",
                hint="give the address of the one that you mean",
                code="robot-ambiguous",
            )
        there = f"these are present: {', '.join(shown)}" if shown else "no robot is present that says who it is"
        raise InputError(
            f"no robot is called {text[:80]!r}", hint=f"{there}; `aira robots` lists them", code="robot-unknown"
        )

    def name(self, address: str) -> str:
        """What the robot at an address calls itself, as far as that is known; or an empty text."""
        profile, _ = self._known.get(address, (None, 0.0))
        return "" if profile is None else profile.name

    async def _ask(self, addresses: Iterable[str], timeout: float) -> Mapping[str, Profile]:
        """The latest profile that each robot has signed."""
        asked = frozenset(addresses)
        return await signed_answers(
            self._session,
            [str(ProfileKey(address)) for address in asked],
            Profile,
            lambda one: one.agent in asked,
            timeout=timeout,
            longest=PROFILE_LIMITS.size,
            made_at=lambda one: one.time,
        )


async def robot_address(session: zenoh.Session, channel: Channel, named: str, *, model: str = "") -> str:
    """The address (EIP-55) of the robot with a name, as `RobotDirectory.named`, or an address as it is given."""
    if named[:2].lower() == "0x":
        return parse_address(named)
    return (await RobotDirectory(session, channel).named(named, model=model)).address


QUOTE_TIMEOUT: Final = 2.0
"""Seconds that robots have to answer by default."""
ASKED: Final = 64
"""Robots that are asked at once, at most."""


async def asked_quotes(
    session: zenoh.Session,
    channel: Channel,
    *,
    asker: Signer,
    robots: Collection[str],
    model: str,
    objective: str,
    token: str = "",
    timeout: float = QUOTE_TIMEOUT,
) -> list[Quote]:
    """The quotes of these `robots` (addresses) that arrive in `timeout` seconds: the cheapest first, refusals last.

    Costs are compared within a token only: those in `token` (an address) come first, then each other token's.
    """
    request = QuoteRequest(
        model=model,
        objective=objective,
        lighthouse=channel.lighthouse,
        asker=asker.address,
        nonce=secrets.token_hex(16),
        time=int(time.time()),
    ).signed_by(asker)
    keys = {str(RpcKey(robot, "quote")): robot for robot in [*robots][:ASKED]}
    found: dict[str, Quote] = {}
    for reply in await query_all(session, keys, payload=request.encode(), timeout=timeout):
        if reply.ok is None:
            continue
        with suppress(InvalidRecord):
            quote = Quote.decode(reply.ok.payload.to_bytes())
            is_asked = keys.get(str(reply.ok.key_expr)) == quote.agent and quote.request == request.identity
            if is_asked and quote.agent not in found and quote.is_signed:
                found[quote.agent] = quote
    return sorted(
        found.values(), key=lambda one: (bool(one.code), one.token != token, one.token, one.cost, one.start, one.agent)
    )
