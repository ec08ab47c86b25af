"""Whether what was played is what the objective asks for. Pure but for reading the files.

A recording that was interrupted and gone on with has seams: behind one, the agent may have begun again with messages
that it had played already, or gone on with one whose recording the crash has cost.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import blake2b
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.evidence.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from mesh.recording import Played
    from schemas.payloads import PayloadType

NAME: Final = "played"
AROUND: Final = 4096
"""Messages around its last position among which a resumed playback may have begun."""
ENOUGH: Final = 64
"""Messages by which such a place is recognised; all of them are compared after that."""


class Sign(NamedTuple):
    """What tells a message from another: its topic and a digest of what it says."""

    topic: str
    digest: bytes


def sign_of(message: Played) -> Sign:
    """The topic, type and payload of a message; its times are the player's matter."""
    return Sign(message.topic, blake2b(message.payload, digest_size=16, salt=_salt_of(message.type)).digest())


@lru_cache(maxsize=4096)
def _salt_of(kind: PayloadType) -> bytes:
    """Bytes that tell a type from another."""
    return blake2b(kind.zenoh_encoding.encode("utf-8", "surrogatepass"), digest_size=blake2b.SALT_SIZE).digest()


def check_played(
    objective: Sequence[Sign], played: Sequence[Sign], *, seams: Iterable[int] = (), complete: bool = True
) -> Finding:
    """Compare the messages of an objective with those that were played, both in their order.

    `seams` are the numbers of played messages after which the agent had broken down and went on. Unless the job is
    known to be `complete`, done with success, the end may be missing.
    """
    seams = frozenset(seams)
    bounds = [0, *sorted({seam for seam in seams if 0 <= seam <= len(played)}), len(played)]
    position, repeated, unseen = 0, 0, 0
    for begin, end in pairwise(bounds):
        part = played[begin:end]
        start = position
        if part and begin in seams:
            start = _resumed(objective, part, position, to_the_end=complete and end == len(played))
        wrong = _difference(objective, part, start)
        if wrong:
            return Finding(NAME, False, wrong)
        repeated += max(0, position - start)
        unseen += max(0, start - position)
        position = start + len(part)
    again = f", {repeated} of them once more after a breakdown" if repeated else ""
    if position < len(objective):
        missing = f"only the first {position} of the objective's {len(objective)} messages were played{again}"
        return Finding(NAME, False if complete else None, missing)
    if unseen:
        return Finding(NAME, None, f"{unseen} messages are not in the recording: the agent broke down just then{again}")
    return Finding(NAME, True, f"all {position} messages of the objective were played, in order{again}")


def _resumed(objective: Sequence[Sign], part: Sequence[Sign], position: int, *, to_the_end: bool) -> int:
    """Where a resumed playback began: the nearest place around `position` from which its messages fit.

    Of one that went `to_the_end` of the objective, that end tells it best.
    """
    last = len(objective) - len(part)
    around = [position - step for step in range(AROUND)] + [position + step for step in range(1, AROUND)]
    for start in [last, *around] if to_the_end else around:
        if 0 <= start <= last and objective[start : start + ENOUGH][: len(part)] == part[:ENOUGH]:
            return start
    return position


def _difference(objective: Sequence[Sign], part: Sequence[Sign], start: int) -> str:
    """What is wrong with the first of the played messages that is not the objective's; empty if all is well."""
    for place, sign in enumerate(part):
        number = start + place
        if number >= len(objective):
            return f"{len(part) - place} messages were played beyond the objective's end, first one on {sign.topic}"
        if sign != objective[number]:
            return _named(objective[number : number + 2], part[place : place + 2], number)
    return ""


def _named(due: Sequence[Sign], came: Sequence[Sign], number: int) -> str:
    """What kind of difference it is: `due` and `came` begin at message `number` and are two messages at most."""
    topic = due[0].topic
    if len(due) == 2 and len(came) == 2 and (due[0], due[1]) == (came[1], came[0]):
        return f"messages {number} on {topic} and {number + 1} on {due[1].topic} were played in the wrong order"
    if len(due) == 2 and came[0] == due[1]:
        return f"message {number} on {topic} was not played"
    if len(came) == 2 and came[1] == due[0]:
        return f"a message on {came[0].topic} was played before message {number} that is not the objective's"
    if came[0].topic == topic:
        return f"message {number} on {topic} was played with another content"
    return f"message {number} on {topic} was not played, but one on {came[0].topic}"
