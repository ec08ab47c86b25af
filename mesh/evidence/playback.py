"""Comparing what was played with the objective. No I/O.

A recording that was interrupted and continued has seams. After a seam, the agent may have repeated messages that it had
already played, or continued after messages that the crash removed from the recording.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import blake2b
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.evidence.claims import Finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from mesh.recording import Played
    from schemas.payloads import PayloadType

_NAME: Final = "played"
_SEARCH_RANGE: Final = 4096
"""Messages around its last position among which a resumed playback may have begun."""
_PREFIX: Final = 64
"""Messages by which that position is recognised; all are compared after that."""


class MessageDigest(NamedTuple):
    """Identifies a message: its topic, and a digest of its type and payload."""

    topic: str
    digest: bytes


def digest_of(message: Played) -> MessageDigest:
    """The digest of a message. Times are not part of it: they depend on the playback."""
    return MessageDigest(message.topic, blake2b(message.payload, digest_size=16, salt=_salt_of(message.type)).digest())


@lru_cache(maxsize=4096)
def _salt_of(kind: PayloadType) -> bytes:
    """Bytes that identify a type."""
    return blake2b(kind.zenoh_encoding.encode("utf-8", "surrogatepass"), digest_size=blake2b.SALT_SIZE).digest()


def check_played(
    objective: Sequence[MessageDigest],
    played: Sequence[MessageDigest],
    *,
    seams: Iterable[int] = (),
    complete: bool = True,
) -> Finding:
    """Compare the messages of an objective with the played ones, both in order.

    `seams` are the numbers of played messages after which the agent crashed and continued. A job that is not `complete`
    may have played only the beginning, and lost some of it in a crash.
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
            return Finding(_NAME, False, wrong)
        repeated += max(0, position - start)
        unseen += max(0, start - position)
        position = start + len(part)
    again = f", {repeated} of them repeated after a crash" if repeated else ""
    if position < len(objective):
        missing = f"only the first {position} of the objective's {len(objective)} messages were played{again}"
        return Finding(_NAME, False if complete else None, missing)
    if unseen:
        lost = f"{unseen} messages are not in the recording: the agent crashed there{again}"
        return Finding(_NAME, False if complete else None, lost)
    return Finding(_NAME, True, f"all {position} messages of the objective were played, in order{again}")


def _resumed(
    objective: Sequence[MessageDigest], part: Sequence[MessageDigest], position: int, *, to_the_end: bool
) -> int:
    """Where a resumed playback began: the nearest position around `position` from which its messages match.

    If it went on `to_the_end` of the objective, the end is the best guess.
    """
    last = len(objective) - len(part)
    around = [position - step for step in range(_SEARCH_RANGE)] + [position + step for step in range(1, _SEARCH_RANGE)]
    for start in [last, *around] if to_the_end else around:
        if 0 <= start <= last and objective[start : start + _PREFIX][: len(part)] == part[:_PREFIX]:
            return start
    return position


def _difference(objective: Sequence[MessageDigest], part: Sequence[MessageDigest], start: int) -> str:
    """The first difference between the played messages and the objective; empty if there is none."""
    for place, digest in enumerate(part):
        number = start + place
        if number >= len(objective):
            return f"{len(part) - place} messages were played beyond the objective's end, first one on {digest.topic}"
        if digest != objective[number]:
            return _describe(objective[number : number + 2], part[place : place + 2], number)
    return ""


def _describe(due: Sequence[MessageDigest], played: Sequence[MessageDigest], number: int) -> str:
    """Name the difference at message `number`, from up to two messages of the objective and of the played ones."""
    topic = due[0].topic
    if len(due) == 2 and len(played) == 2 and (due[0], due[1]) == (played[1], played[0]):
        return f"messages {number} on {topic} and {number + 1} on {due[1].topic} were played in the wrong order"
    if len(due) == 2 and played[0] == due[1]:
        return f"message {number} on {topic} was not played"
    if len(played) == 2 and played[1] == due[0]:
        return f"a message on {played[0].topic} was played before message {number} that is not the objective's"
    if played[0].topic == topic:
        return f"message {number} on {topic} was played with another content"
    return f"message {number} on {topic} was not played, but one on {played[0].topic}"
