"""Which faults a history has: chosen by its seed, few kinds in some histories and many in others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import random

SHARES: Final = (0.0, 0.3, 0.3, 0.6)
"""How many of the kinds a history has: none in some."""


@dataclass
class FaultPlan:
    """How often each kind happens. Intervals are mean seconds, zero is never; the others are probabilities."""

    drop: float = 0.0
    duplicate: float = 0.0
    delay: float = 0.0
    replay: float = 0.0
    """That a message arrives again, up to minutes later: anybody may repeat what is signed."""
    partition_every: float = 0.0
    router_every: float = 0.0
    crash: float = 0.0
    """That a process crashes at one of its first steps or commits; it is asked again at each start."""
    crash_every: float = 0.0
    reorganise_every: float = 0.0
    forget: float = 0.0
    leave_out: float = 0.0
    price_every: float = 0.0
    unreachable: float = 0.0
    silent: float = 0.0
    late: float = 0.0
    spoilt: float = 0.0
    lost_after_sending: float = 0.0
    outage_every: float = 0.0
    clock_every: float = 0.0
    full_every: float = 0.0
    """Disks that are full for a while."""
    leave: float = 0.0
    """That a robot leaves for good; another one stays."""
    preempt: float = 0.0
    reorganise_after: float = 0.0
    """That a block with events is replaced soon after it was mined."""
    repeat_every: float = 0.0
    """A stranger publishes orders again that it has heard: all, or so many that they are chosen at random."""
    withdraw: float = 0.0
    """That a person withdraws an order."""
    revoke: float = 0.0
    """That a person takes the allowance for an order away for a while."""
    short_lived: float = 0.0
    """That an order is valid for a few blocks only."""
    pair: float = 0.0
    """That a person orders from one robot alone, which is named or chosen by its quote."""
    retry: float = 0.0
    """That a job is ordered again when it has failed, or begins late."""
    stop: float = 0.0
    """That a person stops a job."""
    owner_stop: float = 0.0
    """That the owner of a robot stops a job."""
    hand_back: float = 0.0
    """That a robot hands a job back."""
    lasts: float = 0.0
    """Seconds after which all faults stop, though people go on; zero: not before people are done, or time is up."""

    @property
    def has_faults(self) -> bool:
        """Whether anything happens that people and robots' owners do not do by themselves."""
        return any(getattr(self, kind) for kind in RANGES)


RANGES: Final[dict[str, tuple[float, float]]] = {
    "drop": (0.02, 0.4),
    "duplicate": (0.05, 0.5),
    "delay": (0.05, 0.5),
    "replay": (0.05, 0.5),
    "partition_every": (30, 300),
    "router_every": (100, 600),
    "crash": (0.1, 0.7),
    "crash_every": (30, 400),
    "reorganise_every": (15, 200),
    "forget": (0.01, 0.1),
    "leave_out": (0.05, 0.5),
    "price_every": (100, 600),
    "unreachable": (0.01, 0.2),
    "silent": (0.001, 0.01),
    "late": (0.01, 0.2),
    "spoilt": (0.002, 0.03),
    "lost_after_sending": (0.05, 0.3),
    "outage_every": (60, 400),
    "clock_every": (2, 200),
    "full_every": (30, 300),
    "leave": (0.3, 1.0),
    "preempt": (0.01, 0.1),
    "reorganise_after": (0.1, 0.8),
    "repeat_every": (20, 200),
}


WHIMS: Final[dict[str, tuple[float, ...]]] = {
    "withdraw": (0.1, 0.2, 0.7),
    "revoke": (0.0, 0.0, 0.5),
    "short_lived": (0.4,),
    "pair": (0.0, 0.3, 0.7),
    "retry": (0.0, 0.6),
    "stop": (0.0, 0.1, 0.4),
    "owner_stop": (0.0, 0.0, 0.3),
    "hand_back": (0.0, 0.1, 0.3),
}
"""What people and robots' owners do by themselves, and how often: in all histories that do not exclude it."""
KINDS: Final = (*RANGES, *WHIMS)
LASTS: Final = (10, 150)


def choose(
    chance: random.Random, *, only: frozenset[str] | None = None, without: frozenset[str] = frozenset()
) -> FaultPlan:
    """The faults of a history: all of the kinds in `only`, or of all kinds but `without` some."""
    plan, level = FaultPlan(), chance.choice(SHARES) if only is None else 1.0
    for name in RANGES:
        is_chosen, value = chance.random() < level, chance.uniform(*RANGES[name])
        if is_chosen and (only is None or name in only) and name not in without:
            setattr(plan, name, value)
    plan.lasts = chance.choice([0.0, *(2 * [chance.uniform(*LASTS)])])
    for name, shares in WHIMS.items():
        share = chance.choice(shares)
        if (only is None or name in only) and name not in without:
            setattr(plan, name, share)
    return plan
