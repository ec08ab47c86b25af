"""Recordings as evidence: whether an objective, a result and what the chain says of them belong together.

`verify` reads the two files of a job once, and compares them with the `Claim`: the signature, the metadata, whether the
recording is as a recorder writes it, with nothing missing, moved or added, when it was made, and whether what was to be
played was played.

Each time a recorder opens the file, it writes the time of day and the log time that stands for it. From there it counts
by a monotonic clock, so that setting the machine's clock moves no message. A recording that was interrupted and
continued has seams: after one, the agent may have repeated messages that it had already played, or continued after
messages that the crash removed from the recording.

A result that the legacy software recorded is a ROS 1 bag with topics below `/liability/eth_ADDRESS`. It has both what
was played and what the device said, and nothing says which is which: on each topic, the messages of the objective in
their order count as played.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache, partial
from hashlib import blake2b
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, cast, get_args

import msgspec
from msgspec import Struct

from mesh.errors import InvalidAddress, InvalidMessage
from mesh.recording import (
    ABOUT,
    CLOCK_RECORD,
    CLOSED,
    GENEROUS,
    NOTE_TOPIC,
    RECOVERED,
    MessageRole,
    RecordingError,
    open_objective,
)
from mesh.recording.ros import LEGACY_TOPIC
from schemas import Result, cid_of_file, parse_address
from schemas.signing import verify as verify_signature

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording import ChannelMessage, Limits, Objective, Played
    from schemas import Liability, Verified
    from schemas.payloads import PayloadType


class Finding(Struct, frozen=True):
    """The outcome of one check. `holds` is None if it can't be decided; `detail` is for people.

    `name` is machine-readable: `objective-file`, `result-file`, `finalized`, `signature`, `readable`, `statistics`,
    `closed`, `sequence`, `times`, `duplicates`, `roles`, `clock`, `period`, `liability`, `agent`, `lighthouse`,
    `objective`, `played`.
    """

    name: str
    holds: bool | None
    detail: str


class Verdict(Struct, frozen=True):
    """All findings, in the order of the checks."""

    findings: tuple[Finding, ...]

    @property
    def holds(self) -> bool:
        """Whether no check failed."""
        return all(finding.holds is not False for finding in self.findings)

    def of(self, name: str) -> Finding | None:
        """The finding of that name, if any."""
        return next((finding for finding in self.findings if finding.name == name), None)


class Claim(Struct, frozen=True, kw_only=True):
    """What is claimed of a job; a field is empty (or None) if nothing is claimed.

    `liability`, `promisor` and `lighthouse` are addresses (EIP-55), `objective` and `result` CIDs. `finalized` and
    `success` are the contract's.
    """

    liability: str = ""
    promisor: str = ""
    lighthouse: str = ""
    objective: str = ""
    result: str = ""
    success: bool | None = None
    finalized: bool | None = None

    @classmethod
    def of_contract(cls, liability: Liability) -> Claim:
        """The claim of a contract."""
        return cls(
            liability=liability.address,
            promisor=liability.promisor,
            lighthouse=liability.lighthouse,
            objective=liability.objective,
            result=liability.result,
            success=liability.is_success if liability.is_finalized else None,
            finalized=liability.is_finalized,
        )


def check_end(claim: Claim) -> Finding:
    """Whether the contract has ended with a result, which it accepts only with the promisor's signature."""
    match claim:
        case Claim(finalized=None):
            return Finding("finalized", None, "no contract was checked")
        case Claim(finalized=False):
            return Finding("finalized", False, "the contract has not ended, and holds no result yet")
        case Claim(result=""):
            return Finding("finalized", False, "the contract was refunded or cancelled, and holds no result")
    paid = "paid" if claim.success else "refunded, as the work was not done"
    return Finding("finalized", True, f"the contract has ended with this result: {paid}")


def read_result(message: bytes) -> Verified[Result] | str:
    """The Result in an encoded message, or why there is none."""
    try:
        verified = verify_signature(message)
    except InvalidMessage as error:
        return f"the Result message: {error.detail}"
    if isinstance(verified.message, Result):
        return cast("Verified[Result]", verified)
    return f"the message is not a Result but a {type(verified.message).__name__}"


def _check_signature(claim: Claim, signed: Verified[Result] | str | None, *, recording: str) -> Finding:
    """Who signed the result. `signed` is the Result (or why it can't be read), `recording` the CID of the file at hand.

    Without a message, a finalized contract is the proof: it accepts a result only with its promisor's signature.
    """
    if signed is None:
        if claim.finalized and claim.result:
            return Finding("signature", True, f"{claim.promisor} signed it: the contract accepts no other")
        return Finding("signature", None, "there is neither a Result message nor an ended contract")
    if isinstance(signed, str):
        return Finding("signature", False, signed)
    result, signer = signed.message, signed.signer
    if result.result != recording:
        return Finding("signature", False, f"the Result message is for another recording, {result.result}")
    if claim.liability and result.liability != claim.liability:
        return Finding("signature", False, f"the Result message is for another liability, {result.liability}")
    if claim.promisor and signer != claim.promisor:
        return Finding("signature", False, f"{signer} signed it, and the promisor is {claim.promisor}")
    whom = "the promisor, " if claim.promisor else ""
    return Finding("signature", True, f"{whom}{signer}, signed it with success {str(result.success).lower()}")


def _supplemented(claim: Claim, signed: Verified[Result]) -> Claim:
    """The claim, completed from a signed Result where no contract is known: for an arbiter without a chain."""
    if claim.liability:
        return claim
    result = signed.message
    return msgspec.structs.replace(
        claim,
        liability=result.liability,
        promisor=claim.promisor or signed.signer,
        result=claim.result or result.result,
        success=result.success if claim.success is None else claim.success,
    )


def _check_about(claim: Claim, metadata: Mapping[str, Mapping[str, str]]) -> Iterator[Finding]:
    """Compare the job in the recording's metadata with the claim, one finding for each field."""
    about = metadata.get(ABOUT)
    if about is None:
        yield Finding("liability", False, f"the recording has no metadata {ABOUT!r}, and so names no liability")
        return
    claimed = {"liability": claim.liability, "agent": claim.promisor}
    claimed |= {"lighthouse": claim.lighthouse, "objective": claim.objective}
    for name, expected in claimed.items():
        yield _compared(name, about.get(name, ""), expected)


def _compared(name: str, said: str, claimed: str) -> Finding:
    if not said:
        return Finding(name, False, f"the recording names no {name}")
    if not claimed:
        return Finding(name, None, f"the recording names the {name} {said[:80]!r}, with nothing to compare it to")
    if _canonical(said) != _canonical(claimed):
        return Finding(name, False, f"the recording names the {name} {said[:80]!r}, and it should be {claimed}")
    return Finding(name, True, f"the recording names the {name} {claimed}")


def _canonical(text: str) -> str:
    """An address in its canonical form; any other text unchanged."""
    try:
        return parse_address(text)
    except InvalidAddress:
        return text


MOST_SEAMS: Final = 256
"""Crashes of one job that are believed."""


@dataclass(frozen=True)
class RecorderParts:
    """The parts of a recording, as its metadata state them: each begins where a recorder was opened.

    `begins` are the numbers of their first messages; the first is 0. `unix_ns` and `log_ns` are the time of day at
    which each was begun, and its log time. `fault` is why no recorder writes such metadata; empty if one does.
    """

    begins: tuple[int, ...]
    unix_ns: tuple[int, ...] = ()
    log_ns: tuple[int, ...] = ()
    fault: str = ""

    @classmethod
    def of(cls, metadata: Mapping[str, Mapping[str, str]]) -> RecorderParts:
        """The parts that the metadata of a recording state."""
        seams = _numbers(metadata.get(RECOVERED, {}).get("seams", ""))
        if seams is None or list(seams) != sorted(seams):
            return cls(
                (0,), fault=f"it does not state in order where the agent continued after at most {MOST_SEAMS} crashes"
            )
        stated = metadata.get(CLOCK_RECORD, {})
        unix, log = _numbers(stated.get("unix_ns", "")), _numbers(stated.get("log_ns", ""))
        later = tuple(seam for seam in seams if seam)
        if not unix or not log or len(unix) != len(log):
            return cls((0, *later), fault="it does not state at what time of day it was begun")
        # A part without messages may be lost with its metadata.
        at_once = len(unix) - len(later)
        if not 1 <= at_once <= 1 + len(seams) - len(later):
            return cls(
                (0, *later), fault=f"it states {len(unix)} times at which it was begun, and {len(seams)} crashes"
            )
        return cls((0,) * at_once + later, unix, log)


@dataclass
class ClockCheck:
    """Compares the times of messages, added in file order, with the clock that the recorder wrote."""

    parts: RecorderParts
    part: int = 0
    _count: int = 0
    _last: int = 0
    """The latest log time so far."""
    _counted: int = 0
    """Nanoseconds from the begin of each earlier part to its last message, together."""
    _fault: str = field(default="", init=False)

    def __post_init__(self) -> None:
        self._seams = (*self.parts.begins[1:], -1)
        """The number of the first message of the part that follows each part; -1 for the last one."""
        self._fault = self.parts.fault or self._begin_fault(0)

    def add(self, time: int) -> int:
        """Add the log time of the next message. Returns the number of its part, from 0."""
        while self._count == self._seams[self.part]:
            self._enter()
        self._count += 1
        if time < self._begun() and not self._fault:
            self._fault = f"message {self._count - 1} was recorded before the recorder was opened"
        self._last = max(self._last, time)
        return self.part

    def finding(self) -> Finding:
        """Whether the recorder's clock and the times of the messages agree, once all are added."""
        while 0 <= self._seams[self.part] <= self._count:
            self._enter()
        if not self._fault and self._seams[self.part] >= 0:
            self._fault = f"it states a crash after message {self._seams[self.part]}, and has {self._count}"
        if self._fault:
            return Finding("clock", False, self._fault)
        return Finding("clock", True, f"it was begun at {shown(self.parts.unix_ns[0])} by the robot's clock")

    def period(self, since_ns: int, until_ns: int) -> Finding:
        """Whether it was made between these times of day, once all are added.

        What a crash adds counts as nothing: only the robot's clock says how long it took.
        """
        if not self.parts.log_ns:
            return Finding("period", False, self._fault or "it does not state when it was made")
        start = self.parts.log_ns[0]
        end = start + self._counted + max(0, self._last - self._begun())
        made = f"it was made from {shown(start)} to {shown(end)} by the robot's clock"
        if start < since_ns:
            return Finding("period", False, f"{made}, which begins before the job did, at {shown(since_ns)}")
        if end > until_ns:
            return Finding("period", False, f"{made}, which ends after its result was there, at {shown(until_ns)}")
        return Finding("period", True, made)

    def _enter(self) -> None:
        self._counted += max(0, self._last - self._begun())
        self.part += 1
        self._fault = self._fault or self._begin_fault(self.part)

    def _begun(self) -> int:
        """The log time at which this part was begun."""
        return self.parts.log_ns[self.part] if self.parts.log_ns else 0

    def _begin_fault(self, part: int) -> str:
        if self.parts.fault or self.parts.log_ns[part] == max(self.parts.unix_ns[part], self._last):
            return ""
        return f"part {part + 1} of it begins at another time than the one at which its recorder was opened"


def _numbers(text: str) -> tuple[int, ...] | None:
    """Numbers separated by commas, at most `MOST_SEAMS` and one more; None for anything else."""
    words = text.split(",", MOST_SEAMS + 1) if text else []
    if len(words) > MOST_SEAMS + 1:
        return None
    if not all(word.isascii() and word.isdigit() and len(word) <= 20 for word in words):
        return None
    return tuple(map(int, words))


def shown(time_ns: int) -> str:
    """A time of day for people: UTC, in seconds."""
    try:
        return f"{datetime.fromtimestamp(time_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError, OSError):
        return f"{time_ns} ns"


_NAME: Final = "played"


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
    objective: Sequence[MessageDigest],
    part: Sequence[MessageDigest],
    position: int,
    *,
    to_the_end: bool,
    distance: int = 4096,
    compared: int = 64,
) -> int:
    """Where a resumed playback began: the nearest position around `position`, less than `distance` messages away,
    from which its first messages match. So many are `compared` here, and all after that.

    If it went on `to_the_end` of the objective, the end is the best guess.
    """
    last = len(objective) - len(part)
    around = [position - step for step in range(distance)] + [position + step for step in range(1, distance)]
    for start in [last, *around] if to_the_end else around:
        if 0 <= start <= last and objective[start : start + compared][: len(part)] == part[:compared]:
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


_ONLY_MCAP: Final = (
    "statistics",
    "closed",
    "sequence",
    "times",
    "duplicates",
    "roles",
    "clock",
    "agent",
    "lighthouse",
    "objective",
)
NOT_IN_BAGS: Final = frozenset({"readable", *_ONLY_MCAP})
"""Findings that stay undecided for every bag."""


class LegacyRecording:
    """The messages of the job `liability` in a bag, as a recorder of ours writes them. `objective` is what was due."""

    def __init__(self, recording: Objective, liability: str, objective: Objective | None) -> None:
        self._recording, self._claimed, self._objective = recording, liability, objective
        self.metadata: Final[Mapping[str, Mapping[str, str]]] = {}
        self.start_ns: Final = recording.start_ns
        matches = [LEGACY_TOPIC.fullmatch(topic.name) for topic in recording.topics]
        self._named = sorted({named[1].lower() for named in matches if named is not None})
        self._job = liability.lower() or (self._named[0] if len(self._named) == 1 else "")
        self._missing: Counter[str] = Counter()
        """How many of the messages due on each topic are not there in their order, once all are read."""

    def in_file_order(self) -> Iterator[ChannelMessage]:
        """The job's messages, with topics as in the objective and with roles."""
        due: dict[str, deque[MessageDigest]] = {}
        for message in () if self._objective is None else self._objective.messages():
            due.setdefault(message.topic, deque()).append(digest_of(message))
        for written in self._recording.in_file_order():
            named = LEGACY_TOPIC.fullmatch(written.message.topic)
            if named is None or named[1].lower() != self._job:
                continue
            message = msgspec.structs.replace(written.message, topic=named[2], role="device")
            if (waiting := due.get(message.topic)) and waiting[0] == digest_of(message):
                waiting.popleft()
                message = msgspec.structs.replace(message, role="objective")
            yield msgspec.structs.replace(written, message=message)
        self._missing = Counter({topic: len(waiting) for topic, waiting in due.items() if waiting})

    def findings(self) -> Iterator[Finding]:
        """What the bag says by itself, and which checks can't be made."""
        yield Finding("readable", None, f"{self._recording.count} messages in a ROS 1 bag, which has no checksums")
        yield self._liability()
        for name in _ONLY_MCAP:
            yield Finding(name, None, "does not apply: a ROS 1 bag does not hold what it checks")

    def played(self, *, complete: bool) -> Finding:
        """Whether each topic of the job has the messages of the objective, in order, once all are read.

        Others may be between them.
        """
        count = 0 if self._objective is None else self._objective.count
        if not self._missing:
            return Finding("played", True, f"all {count} messages of the objective are in the bag, in order")
        of = f"{self._missing.total()} of the objective's {count} messages"
        why = f"{of} are not in the bag in their order, first on {next(iter(self._missing))}"
        return Finding("played", False if complete else None, why)

    def period(self, since_ns: int, until_ns: int) -> Finding:
        """Whether it was made between these times of day, by the times of its messages."""
        start, end = self.start_ns, self.start_ns + self._recording.duration_ns
        made = f"its messages are from {shown(start)} to {shown(end)} by the robot's clock"
        job = f"the job was done from {shown(since_ns)} to {shown(until_ns)}"
        return Finding("period", since_ns <= start and end <= until_ns, f"{made}; {job}")

    def _liability(self) -> Finding:
        named = f"its topics name the liability {', '.join(self._named)[:80]}"
        if not self._named:
            return Finding("liability", False, "no topic begins with /liability/eth_ADDRESS, so it names no liability")
        if not self._claimed:
            return Finding("liability", None, f"{named}, with nothing to compare it to")
        if self._claimed.lower() not in self._named:
            return Finding("liability", False, f"{named}, and it should be {self._claimed}")
        return Finding("liability", True, f"its topics name the liability {self._claimed}")


_ROLES: Final = frozenset(get_args(MessageRole))


@dataclass
class Faults:
    """The first fault of a kind, and how many there are: a stranger's file may have any number."""

    first: str = ""
    count: int = 0

    def add(self, fault: str) -> None:
        self.first = self.first or fault
        self.count += 1

    def finding(self, name: str, well: str) -> Finding:
        """The finding of that name: the first fault, or that all is `well`."""
        if not self.count:
            return Finding(name, True, well)
        more = f" (and {self.count - 1} more)" if self.count > 1 else ""
        return Finding(name, False, self.first + more)


@dataclass(slots=True)
class _ChannelCount:
    """What was read of one channel."""

    topic: str
    role: str
    count: int = 0
    next: int = 0


@dataclass
class SequenceCheck:
    """Checks the messages of a recording in file order for missing, repeated and moved ones."""

    channels: dict[int, _ChannelCount] = field(default_factory=dict)
    gaps: Faults = field(default_factory=Faults)
    steps_back: Faults = field(default_factory=Faults)
    copies: Faults = field(default_factory=Faults)
    last: ChannelMessage | None = None

    def add(self, written: ChannelMessage) -> None:
        """Check the next message."""
        message = written.message
        channel = self.channels.get(written.channel)
        if channel is None:
            channel = self.channels[written.channel] = _ChannelCount(message.topic, message.role)
        if message.sequence != channel.next:
            self.gaps.add(_gap(message.topic, message.sequence, channel.next))
        channel.count += 1
        channel.next = message.sequence + 1
        if self.last is not None:
            self._compare(written, self.last)
        self.last = written

    def _compare(self, written: ChannelMessage, last: ChannelMessage) -> None:
        """Compare a message with the one before it."""
        message, earlier = written.message, last.message.log_time_ns - written.message.log_time_ns
        if earlier < 0:
            return
        name = f"message {message.sequence} on {message.topic}"
        if earlier > 0:
            self.steps_back.add(f"{name} was recorded {earlier / 10**6:g} ms before the previous one")
        elif written.channel == last.channel and message.payload == last.message.payload:
            self.copies.add(f"{name} has the time and content of the one before it")


def check_completeness(recording: Objective, sequence: SequenceCheck) -> Iterator[Finding]:
    """Check a recording whose messages were all added to `sequence`."""
    if recording.unchecked:
        yield Finding("readable", None, f"{recording.unchecked} blocks of it have no checksum")
    else:
        yield Finding("readable", True, f"{recording.count} messages, and every checksum is right")
    yield _check_statistics(recording, sequence)
    yield _check_closed(recording)
    yield sequence.gaps.finding("sequence", "the messages of every channel are numbered without a gap")
    yield sequence.steps_back.finding("times", "the messages are in the order of their times")
    yield sequence.copies.finding("duplicates", "no message is a copy of the one before")
    yield _check_roles(recording, sequence)


def _gap(topic: str, number: int, expected: int) -> str:
    if number < expected:
        return f"message {number} on {topic} comes after message {expected - 1}"
    if number == expected + 1:
        return f"message {expected} on {topic} is missing"
    return f"messages {expected} to {number - 1} on {topic} are missing"


def _check_statistics(recording: Objective, sequence: SequenceCheck) -> Finding:
    said = recording.statistics
    if said is None:
        return Finding("statistics", False, "the file does not state how many messages it has")
    if said.messages != recording.count:
        return Finding("statistics", False, f"the file states {said.messages} messages, and has {recording.count}")
    counted = {number: channel.count for number, channel in sequence.channels.items()}
    if {number: count for number, count in said.by_channel.items() if count} != counted:
        return Finding("statistics", False, "the file states other numbers of messages on its channels than it has")
    if recording.count and (said.start, said.end) != (recording.start_ns, recording.start_ns + recording.duration_ns):
        return Finding("statistics", False, "the file states other times of its first and last message than it has")
    if (said.channels, said.attachments) != (recording.channels, len(recording.attachments)):
        return Finding("statistics", False, "the file states other numbers of channels and attachments than it has")
    return Finding("statistics", True, "the file has the messages, channels and times that it states")


def _check_closed(recording: Objective) -> Finding:
    if recording.repeated:
        name = min(recording.repeated)
        return Finding("closed", False, f"it has several metadata records {name[:80]!r}, and a recorder writes one")
    closing = recording.metadata.get(CLOSED)
    if closing is None:
        return Finding("closed", False, "the recorder did not close it: the end may be missing")
    if closing.get("messages") != str(recording.count):
        stated = closing.get("messages", "unknown")[:20]
        said = f"the recorder closed it with {stated} messages, and it has {recording.count}"
        return Finding("closed", False, said)
    if closing.get("lost") != "0":
        return Finding("closed", False, f"the recorder lost {closing.get('lost', 'unknown')[:20]} messages")
    if RECOVERED in recording.metadata:
        return Finding("closed", None, "the agent crashed and continued: the last second before may be missing")
    return Finding("closed", True, "the recorder closed it and had lost nothing")


def _check_roles(recording: Objective, sequence: SequenceCheck) -> Finding:
    """Whether each channel says who sent its messages, and may carry them."""
    chosen = chosen_topics(recording)
    for channel in sequence.channels.values():
        if channel.role not in _ROLES:
            said = f"the messages on {channel.topic} have the unknown role {channel.role[:40]!r}"
            return Finding(
                "roles", False, said if channel.role else f"nothing says who sent the messages on {channel.topic}"
            )
        if channel.role == "agent" and channel.topic != NOTE_TOPIC:
            return Finding(
                "roles", False, f"messages on {channel.topic} are the agent's, which writes on {NOTE_TOPIC} only"
            )
        if chosen and channel.role != "agent" and channel.topic not in chosen:
            return Finding("roles", False, f"it has messages on {channel.topic}, which was not to be recorded")
    return Finding("roles", True, "every channel says who sent its messages, and may carry them")


def chosen_topics(recording: Objective) -> frozenset[str]:
    """The topics that were to be recorded; empty for all."""
    return frozenset(name for name in recording.metadata.get(ABOUT, {}).get("topics", "").split(",") if name)


RecordedJob: TypeAlias = "Objective | LegacyRecording"
"""A recording as observers see it."""


class RecordingObserver:
    """Looks at a recording while it is verified, so that the file is read once for all. This one ignores it.

    `open` is called first, `add` for each message in file order with the number of its part: a new part begins where
    the agent crashed and continued. `open_objective` is called last, unless the objective is not readable.
    """

    def open(self, recording: RecordedJob) -> None:
        """Take the recording, whose messages follow."""

    def add(self, message: Played, part: int) -> None:
        """Take the next message."""

    def open_objective(self, objective: Objective) -> None:
        """Take the objective."""


_NOBODY: Final = RecordingObserver()


@dataclass(frozen=True, kw_only=True)
class JobFiles:
    """The `objective` and the `result` (the recording) of a job, and what is known of them.

    `message` is the encoded Result. Give the CIDs of files that were fetched by them: a CID made with other settings
    than ours can't be computed from the file. `period` is when the job was done: from when to when, in nanoseconds of
    Unix time.
    """

    objective: Path
    result: Path
    message: bytes | None = None
    objective_cid: str = ""
    result_cid: str = ""
    period: tuple[int, int] | None = None


def verify(
    claim: Claim,
    files: JobFiles,
    *,
    bags: bool = False,
    limits: Limits = GENEROUS,
    observer: RecordingObserver = _NOBODY,
    progress: Progress | None = None,
) -> Verdict:
    """Check everything that can be checked: the files behind the two CIDs, the signature, the recording.

    With `bags` the recording may be a bag of the legacy software, of which less can be checked; otherwise a bag fails.
    Files beyond the `limits` are not readable. `observer` sees the messages of the recording. `progress` is called with
    the bytes of both files read, of all.

    Use a thread. Raises `OSError` if a file can't be read.
    """
    sizes = files.result.stat().st_size, files.objective.stat().st_size

    def opened(path: Path, before: int = 0) -> Objective:
        """A file that is opened once; `before` are the bytes that were read of the other one."""
        of_both = None if progress is None else lambda done, _: progress(before + done, sum(sizes))
        return open_objective(path, limits, progress=of_both)

    cids = files.objective_cid or cid_of_file(files.objective), files.result_cid or cid_of_file(files.result)
    signed = None if files.message is None else read_result(files.message)
    findings = [check_end(claim), _check_signature(claim, signed, recording=cids[1])]
    if signed is not None and not isinstance(signed, str):
        claim = _supplemented(claim, signed)
    findings.append(_check_file("result-file", "result", cids[1], claim.result))
    findings.append(_check_file("objective-file", "objective", cids[0], claim.objective))
    if not claim.objective:
        # Without a contract, still check that the two files belong together.
        claim = msgspec.structs.replace(claim, objective=cids[0])
    try:
        recording = opened(files.result)
    except RecordingError as error:
        return Verdict((*findings, Finding("readable", False, f"the recording is not readable: {error.why}")))
    check = _check_bag if bags and recording.format == "bag" else _check_recording
    open_due = partial(opened, files.objective, sizes[0])
    findings += check(claim, recording, open_due, period=files.period, observer=observer)
    return Verdict(tuple(findings))


def _check_bag(
    claim: Claim,
    recording: Objective,
    open_due: Callable[[], Objective],
    *,
    period: tuple[int, int] | None,
    observer: RecordingObserver,
) -> Iterator[Finding]:
    objective, unusable = None, ""
    try:
        objective = open_due()
    except RecordingError as error:
        unusable = error.why
    bag = LegacyRecording(recording, claim.liability, objective)
    observer.open(bag)
    for written in bag.in_file_order():
        observer.add(written.message, 0)
    yield from bag.findings()
    if period is not None:
        yield bag.period(*period)
    if objective is None:
        yield Finding("played", None, f"the objective is not a recording ({unusable})")
        return
    yield bag.played(complete=claim.success is not False)
    observer.open_objective(objective)


def _check_recording(
    claim: Claim,
    recording: Objective,
    open_due: Callable[[], Objective],
    *,
    period: tuple[int, int] | None,
    observer: RecordingObserver,
) -> Iterator[Finding]:
    observer.open(recording)
    sequence, clock, part = SequenceCheck(), ClockCheck(RecorderParts.of(recording.metadata)), 0
    played, seams = list[MessageDigest](), list[int]()
    for written in recording.in_file_order():
        message = written.message
        sequence.add(written)
        if clock.add(message.log_time_ns) != part:
            part = clock.part
            seams.append(len(played))
        if message.role == "objective":
            played.append(digest_of(message))
        observer.add(message, part)
    yield from check_completeness(recording, sequence)
    yield clock.finding()
    if period is not None:
        yield clock.period(*period)
    yield from _check_about(claim, recording.metadata)
    try:
        objective = open_due()
    except RecordingError as error:
        said = "messages were played, but" if played else "nothing was played:"
        yield Finding("played", False if played else None, f"{said} the objective is not a recording ({error.why})")
        return
    yield _check_playback(claim, recording, objective, played, seams)
    observer.open_objective(objective)


def _check_playback(
    claim: Claim, recording: Objective, objective: Objective, played: Sequence[MessageDigest], seams: Sequence[int]
) -> Finding:
    chosen = chosen_topics(recording)
    due = [digest_of(message) for message in objective.messages() if not chosen or message.topic in chosen]
    finding = check_played(due, played, seams=seams, complete=claim.success is not False)
    left_out = objective.count - len(due)
    if not left_out or finding.holds is False:
        return finding
    said = f"{finding.detail}; only {len(chosen)} topics were recorded, without {left_out} messages of the objective"
    return Finding(finding.name, None, said)


def _check_file(name: str, what: str, cid: str, claimed: str) -> Finding:
    if not claimed:
        return Finding(name, None, f"the {what} is {cid}, with nothing to compare it to")
    if cid != claimed:
        return Finding(name, False, f"the {what} is {cid}, and it should be {claimed}")
    return Finding(name, True, f"the {what} is {cid}")
