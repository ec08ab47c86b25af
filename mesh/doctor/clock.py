"""This machine's clock against others: the router's and the chain's. Pure but for the time.

A clock that is wrong takes certificates for expired, or for not yet valid, and makes the times in recordings worthless.
"""

from __future__ import annotations

import time
from typing import Final

from mesh.doctor.findings import Finding, broken, sound

DAY: Final = 86_400.0
SOON: Final = 7 * DAY
"""Seconds before its end in which a certificate is to be renewed."""
TOLERATED: Final = 5.0
"""Seconds by which two clocks may differ."""
AHEAD: Final = 30.0
"""Seconds by which a block may be from the future: development chains count a second for each block, however soon."""
RECENT: Final = 120.0
"""Seconds for which a block says something about the time."""
CURE: Final = (
    "set the clock, best by NTP (timedatectl set-ntp true); certificates hold by it, and recordings have their times"
    " from it"
)


def against_router(theirs: float, ours: float) -> Finding:
    """The router's clock and this one, read at the same moment (seconds since 1970)."""
    ahead = ours - theirs
    if abs(ahead) <= TOLERATED:
        return sound(f"{abs(ahead):.2f} s from the router's clock")
    return broken(f"this machine's clock is {_apart(ahead)} the router's", do=CURE)


def against_node(theirs: float, ours: float) -> Finding:
    """The clock of the node's machine, which tells whole seconds, and this one (seconds since 1970)."""
    ahead = ours - theirs
    if abs(ahead) <= TOLERATED + 1:
        return sound("as the node's clock, to the second")
    return broken(f"this machine's clock is {_apart(ahead)} that of the node's machine", do=CURE)


def against_chain(block_time: float, ours: float) -> Finding:
    """The time of the newest block, and the clock (seconds since 1970)."""
    age = ours - block_time
    if age < -AHEAD:
        return broken(f"the newest block is from the future: this clock is {spoken(-age)} behind the chain's", do=CURE)
    if age > RECENT:
        return sound(f"the newest block is {spoken(age)} old, and says nothing about the clock")
    return sound(f"fits the newest block, {'of now' if age < 1 else spoken(age) + ' old'}")


def spoken(seconds: float) -> str:
    """A length of time in the unit that says it best."""
    for name, length in (("days", DAY), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {name}"
    return f"{seconds:.0f} s"


def days_left(until: float) -> str:
    """How long it is until then (seconds since 1970)."""
    left = until - time.time()
    return f"{spoken(left)} left" if left > 0 else "over"


def _apart(ahead: float) -> str:
    return f"{spoken(abs(ahead))} {'ahead of' if ahead > 0 else 'behind'}"
