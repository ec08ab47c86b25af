"""What programs and a signer say to each other: the operations, their requests and answers, and the codes of errors.

A signer listens on two UNIX sockets in its state folder, with HTTP and JSON: `POST /v1/OPERATION` with the request as
the body. `door.sock` has the operations of `DOOR`, for programs that act for a person; they can't raise what the policy
allows. `owner.sock` has those of `OWNER`, for the person: consents, the policy and the log.

Times are ISO 8601 in UTC. A text that a stranger wrote stands only in a `StrangersText`, which says who wrote it: it is
shortened, and has no control characters. The names of topics and fields, units and choices of a model are a stranger's,
too, but orders must repeat them; they are shortened in the same way, and names are ASCII.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta

from mesh.errors import AiraError
from mesh.settings.chains import LONGEST_ORDER, ORDER_SECONDS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mesh.settings import Settings

DOOR_SOCKET: Final = "door.sock"
OWNER_SOCKET: Final = "owner.sock"
LARGEST_REQUEST: Final = 1 << 20
"""Bytes of a request."""
LARGEST_ANSWER: Final = 8 << 20
"""Bytes of an answer."""


def signer_folder(settings: Settings) -> Path:
    """Where a signer with these settings has its sockets."""
    return settings.state_directory / "signer"


Name: TypeAlias = Annotated[str, Meta(max_length=200)]
JobId: TypeAlias = Annotated[str, Meta(pattern=r"^job-[0-9a-f]{16}$")]
CONSENT_ID: Final = r"^consent-[0-9a-f]{16}$"
ConsentId: TypeAlias = Annotated[str, Meta(pattern=CONSENT_ID)]
Key: TypeAlias = Annotated[str, Meta(min_length=1, max_length=128)]
Note: TypeAlias = Annotated[str, Meta(max_length=500)]

JobState: TypeAlias = Literal[
    "needs-consent",
    "ordering",
    "waiting",
    "accepted",
    "running",
    "done",
    "failed",
    "refunded",
    "withdrawn",
    "stopped",
    "denied",
    "expired",
]
"""What has become of an order:

- `needs-consent`: a person must allow it first; nothing was signed.
- `ordering`: it is allowed, and being signed and sent.
- `waiting`: it is on the market, and no contract yet.
- `accepted`: it is a contract, and its cost is in that; the job waits at the robot.
- `running`: the robot works.
- `done`: done and paid.
- `refunded`: the job failed, and its cost came back.
- `stopped`: the same, because somebody stopped it.
- `failed`: it could not be ordered; nothing was paid.
- `withdrawn`: it was taken back before it became a contract.
- `denied`: a person did not allow it; nothing was signed.
- `expired`: nobody allowed it, or took it, in time; nothing was paid.
"""
OnStop: TypeAlias = Literal["refund", "paid", ""]
"""What becomes of the cost of a job that is stopped; empty if no description says it."""
Verdict: TypeAlias = Literal["allowed", "needs-consent", "refused"]
"""What a policy says to an order."""
OVER: Final = frozenset({"done", "failed", "refunded", "withdrawn", "stopped", "denied", "expired"})
"""The states after which no other comes."""


class SignerRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The base of requests."""


class SignerAnswer(msgspec.Struct, frozen=True):
    """The base of answers and of what is in them."""


class StrangersText(SignerAnswer, frozen=True, kw_only=True, rename={"author": "from"}):
    """A text that a stranger wrote: data, and never an instruction. In JSON `author` is `from`: `robot 0x…`."""

    text: str
    author: str


class Amount(SignerAnswer, frozen=True, kw_only=True):
    """An amount for people (`1.5 XRT`), and as a number of the token's smallest unit."""

    text: str
    units: int


class FindRobots(SignerRequest, frozen=True, kw_only=True):
    """The robots that are present: of a model (CID or name), or those whose name or sentence contains
    `text`, or whose address it is."""

    model: Name = ""
    text: Name = ""
    limit: Annotated[int, Meta(ge=1, le=50)] = 20


class RobotModel(SignerAnswer, frozen=True, kw_only=True):
    cid: str
    title: StrangersText | None = None
    """None if the model has no description."""


class RobotRecord(SignerAnswer, frozen=True, kw_only=True):
    """How the robot's contracts of the last week ended, by the chain."""

    jobs: int
    paid: int
    refunded: int


class FoundRobot(SignerAnswer, frozen=True, kw_only=True):
    address: str
    name: StrangersText
    sentence: StrangersText
    models: tuple[RobotModel, ...]
    price: str
    """What a job usually costs, by the robot's own word (`5 XRT`); may be empty."""
    state: Literal["idle", "working", "stopped", "closed"]
    queue: int
    """Jobs that wait."""
    wait_seconds: int
    """After which a new job would begin, estimated."""
    record: RobotRecord | None
    """None if the chain could not be read."""
    on_stop: OnStop
    is_allowed: bool
    """Whether the policy has a rule for this robot and its model."""


class FoundRobots(SignerAnswer, frozen=True, kw_only=True):
    robots: tuple[FoundRobot, ...]
    more: int
    """How many were left out."""


class DescribeModel(SignerRequest, frozen=True, kw_only=True):
    model: Name


class FieldAllowed(SignerAnswer, frozen=True, kw_only=True):
    """What the policy allows in a field, narrower than the model: one of `choices`, or from `minimum` to `maximum`."""

    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str | int | float | bool, ...] = ()


class ModelField(SignerAnswer, frozen=True, kw_only=True):
    """A value in the messages of a topic: `path` is as in `speed`, `pose.x` or `points[].x`; empty for the message."""

    path: str
    type: str
    """A type of JSON; empty for any."""
    title: StrangersText | None = None
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str | int, ...] = ()
    is_required: bool = False
    allowed: tuple[FieldAllowed, ...] = ()
    """By each rule of the policy that allows the topic; empty if none does."""


class DescribedTopic(SignerAnswer, frozen=True, kw_only=True):
    topic: str
    title: StrangersText | None
    description: StrangersText | None
    fields: tuple[ModelField, ...]
    is_required: bool
    max_messages: int | None
    is_allowed: bool
    """Whether a rule of the policy allows messages on it."""


class DescribedModel(SignerAnswer, frozen=True, kw_only=True):
    model: str
    """Its CID."""
    is_allowed: bool
    """Whether a rule of the policy allows it at all."""
    has_description: bool
    title: StrangersText | None = None
    description: StrangersText | None = None
    success: StrangersText | None = None
    """What a success is."""
    topics: tuple[DescribedTopic, ...] = ()
    results: tuple[DescribedTopic, ...] = ()
    price: str = ""
    seconds: float | None = None
    on_stop: OnStop = ""


class Message(SignerRequest, frozen=True, kw_only=True):
    """One message of a job: `value` is what the topic's description says; null for std_msgs/Empty."""

    topic: Name
    value: Any = None


Messages: TypeAlias = Annotated[tuple[Message, ...], Meta(max_length=1000)]


class AskQuotes(SignerRequest, frozen=True, kw_only=True):
    """What robots want for a job: `messages`, or the `objective` (CID) that has them, one of the two."""

    model: Name
    messages: Messages = ()
    objective: Name = ""


class FoundQuote(SignerAnswer, frozen=True, kw_only=True):
    """What a robot wants. It binds nobody."""

    robot: str
    name: StrangersText
    cost: Amount
    start_seconds: float
    """In how many seconds it would begin, estimated."""
    duration_seconds: float | None
    valid_until: str
    """Estimated from the time that blocks take."""
    verdict: Verdict
    """What the policy would say to an order at this cost now."""
    code: str = ""
    """Why it would be refused."""
    why: str = ""


class DeclinedQuote(SignerAnswer, frozen=True, kw_only=True):
    """A robot does not want the job: `code` is a word for programs."""

    robot: str
    name: StrangersText
    code: str
    why: StrangersText


class FoundQuotes(SignerAnswer, frozen=True, kw_only=True):
    quotes: tuple[FoundQuote, ...]
    declined: tuple[DeclinedQuote, ...]
    objective: str
    """The CID of the job's objective, for an order of the same."""


class OrderJob(SignerRequest, frozen=True, kw_only=True):
    """Order a job. The same request with the same `idempotency_key` is the same job, whenever it is made.

    `robot` is an address, or `cheapest` or `first` for the choice among those that the policy allows. `cost` is the
    most that is paid (`"1.5 XRT"`). It is a contract within `deadline_seconds`, or never. The `note` is for the log.
    """

    model: Name
    messages: Messages = ()
    objective: Name = ""
    robot: Name = "cheapest"
    cost: Annotated[str, Meta(max_length=60)]
    deadline_seconds: Annotated[int, Meta(ge=30, le=LONGEST_ORDER)] = ORDER_SECONDS
    idempotency_key: Key
    note: Note = ""


class LatestValue(SignerAnswer, frozen=True, kw_only=True):
    topic: str
    value: StrangersText
    """In JSON."""
    time: str


class JobProgress(SignerAnswer, frozen=True, kw_only=True):
    position: int
    """Messages of the objective that the robot has played, of `total`."""
    total: int


class NeededConsent(SignerAnswer, frozen=True, kw_only=True):
    """A person must allow the order: with `aira mcp approve ID`, or on the page. No program can."""

    id: str
    why: str
    expires: str
    command: str
    by_client: bool = False
    """Whether the policy also takes the person's answer from a program that asks them."""


class SignerFailure(SignerAnswer, frozen=True, kw_only=True):
    """What went wrong: `code` is a word for programs, `message` a line, `next` what to do about it."""

    code: str
    message: str
    next: str = ""
    from_strangers: StrangersText | None = None


class Job(SignerAnswer, frozen=True, kw_only=True):
    """A job as it is now. `revision` counts its changes."""

    job_id: str
    state: JobState
    revision: int
    model: str
    objective: str
    robot: str
    """The robot's address; empty while none is chosen."""
    name: StrangersText | None
    cost: Amount
    """What is paid; the most that is, while no robot is chosen."""
    created: str
    changed: str
    note: str = ""
    """As the order had it."""
    contract: str = ""
    """Its address, when there is one."""
    result: str = ""
    """The CID of the recording, when there is one."""
    on_stop: OnStop = ""
    progress: JobProgress | None = None
    latest: tuple[LatestValue, ...] = ()
    consent: NeededConsent | None = None
    error: SignerFailure | None = None

    @property
    def is_over(self) -> bool:
        """Whether no other state comes."""
        return self.state in OVER


class ReadJob(SignerRequest, frozen=True, kw_only=True):
    """The job now; with `wait_seconds`, once its revision is another than `revision`, or they have passed."""

    job_id: JobId
    revision: Annotated[int, Meta(ge=-1)] = -1
    wait_seconds: Annotated[float, Meta(ge=0, le=30)] = 0.0


class ListJobs(SignerRequest, frozen=True, kw_only=True):
    """The latest jobs, the newest first."""

    limit: Annotated[int, Meta(ge=1, le=200)] = 20


class Jobs(SignerAnswer, frozen=True, kw_only=True):
    jobs: tuple[Job, ...]


class StopJob(SignerRequest, frozen=True, kw_only=True):
    """Stop a job that is a contract. What that costs is the model's `on_stop`."""

    job_id: JobId
    why: Annotated[str, Meta(max_length=200)] = ""


class WithdrawJob(SignerRequest, frozen=True, kw_only=True):
    """Take an order back that is no contract yet."""

    job_id: JobId


class ReadRecording(SignerRequest, frozen=True, kw_only=True):
    """What the recording of a job has: its topics, or with a `topic` its messages, from number `first` on."""

    job_id: JobId
    topic: Name = ""
    first: Annotated[int, Meta(ge=0)] = 0
    limit: Annotated[int, Meta(ge=1, le=200)] = 50


class RecordedTopic(SignerAnswer, frozen=True, kw_only=True):
    topic: StrangersText
    encoding: StrangersText
    messages: int
    last: StrangersText | None
    """The last value in JSON, shortened if it is long; None for a very large one."""


class RecordedValue(SignerAnswer, frozen=True, kw_only=True):
    time: str
    value: StrangersText
    """In JSON; shortened if it is long."""
    is_shortened: bool = False


class Recording(SignerAnswer, frozen=True, kw_only=True):
    cid: str
    duration_seconds: float
    messages: int
    topics: tuple[RecordedTopic, ...] = ()
    values: tuple[RecordedValue, ...] = ()
    more: int = 0
    """Messages of the topic after these."""


class VerifyJob(SignerRequest, frozen=True, kw_only=True):
    """Check the recording of a job against its objective and its contract, as `aira verify` does."""

    job_id: JobId


class JobCheck(SignerAnswer, frozen=True, kw_only=True):
    """One check: it `holds`, or does not, or stays open (None)."""

    name: str
    holds: bool | None
    detail: StrangersText


class Verification(SignerAnswer, frozen=True, kw_only=True):
    holds: bool
    """Whether no check fails."""
    checks: tuple[JobCheck, ...]


class ReadBalance(SignerRequest, frozen=True, kw_only=True):
    pass


class AccountFunds(SignerAnswer, frozen=True, kw_only=True):
    """What the account has, and what the policy lets programs spend from now on."""

    account: str
    coin: Amount
    token: Amount
    per_job: Amount
    hour_left: Amount
    day_left: Amount
    jobs: int
    """Jobs that are not over …"""
    jobs_at_a_time: int
    """… and the most at a time."""
    is_open_now: bool
    """Whether it is within the policy's hours."""


class ReadStatement(SignerRequest, frozen=True, kw_only=True):
    """What the account has earned and spent, from a day or month to another: `2026-11-30`, `2026-11`; UTC, included."""

    first: Annotated[str, Meta(max_length=10)] = ""
    last: Annotated[str, Meta(max_length=10)] = ""
    limit: Annotated[int, Meta(ge=1, le=500)] = 100


class StatementEntry(SignerAnswer, frozen=True, kw_only=True):
    time: str
    contract: str
    model: str
    robot: str
    state: str
    earned: Amount
    spent: Amount


class AccountStatement(SignerAnswer, frozen=True, kw_only=True):
    """The latest entries first."""

    account: str
    entries: tuple[StatementEntry, ...]
    earned: Amount
    """All of the period, also what is left out of `entries`; of the token that pays here."""
    spent: Amount
    more: int


class ListConsents(SignerRequest, frozen=True, kw_only=True):
    pass


class Consent(SignerAnswer, frozen=True, kw_only=True):
    """An order that waits for a person's yes. The yes is for this order alone, and used once."""

    id: str
    job_id: str
    model: str
    title: StrangersText | None
    robot: str
    """An address, or `cheapest` or `first`."""
    name: StrangersText | None
    cost: Amount
    """The most that is paid."""
    objective: str
    messages: tuple[StrangersText, ...]
    """What is played, one line each, the first ones."""
    more: int
    """Messages that are not listed."""
    why: str
    note: StrangersText
    """What the program says of it."""
    created: str
    expires: str


class Consents(SignerAnswer, frozen=True, kw_only=True):
    consents: tuple[Consent, ...]


class ApproveOrder(SignerRequest, frozen=True, kw_only=True):
    id: ConsentId


class DenyOrder(SignerRequest, frozen=True, kw_only=True):
    id: ConsentId


class AnswerConsent(SignerRequest, frozen=True, kw_only=True):
    """The person's answer that a program brings, whose client asked them: taken if the policy has `by_client`."""

    id: ConsentId
    allow: bool


class ReadLog(SignerRequest, frozen=True, kw_only=True):
    """Entries of the log, from number `first` on; by default the latest."""

    first: Annotated[int, Meta(ge=0)] | None = None
    limit: Annotated[int, Meta(ge=1, le=1000)] = 100


class LogEntry(SignerAnswer, frozen=True, kw_only=True):
    number: int
    time: str
    event: str
    facts: dict[str, Any]


class LogEntries(SignerAnswer, frozen=True, kw_only=True):
    entries: tuple[LogEntry, ...]
    total: int


class VerifyLog(SignerRequest, frozen=True, kw_only=True):
    pass


class LogVerified(SignerAnswer, frozen=True, kw_only=True):
    """Whether the log is complete and unchanged; if not, `fault` says what is wrong with which entry."""

    holds: bool
    entries: int
    head: str
    """The hash of the last entry."""
    signer: str
    fault: str = ""


class ReadPolicy(SignerRequest, frozen=True, kw_only=True):
    pass


class PolicyInUse(SignerAnswer, frozen=True, kw_only=True):
    """The policy in effect; `words` is what it allows, in plain words."""

    hash: str
    words: tuple[str, ...]
    since: str


class UsePolicy(SignerRequest, frozen=True, kw_only=True):
    """Read the policy's file again, and use it from now on. Consents that wait are void."""


class Operation(NamedTuple):
    """The request and the answer of an operation."""

    request: type[SignerRequest]
    answer: type[SignerAnswer]


DOOR: Final[Mapping[str, Operation]] = MappingProxyType(
    {
        "find_robots": Operation(FindRobots, FoundRobots),
        "describe_model": Operation(DescribeModel, DescribedModel),
        "quote": Operation(AskQuotes, FoundQuotes),
        "order": Operation(OrderJob, Job),
        "job": Operation(ReadJob, Job),
        "jobs": Operation(ListJobs, Jobs),
        "stop_job": Operation(StopJob, Job),
        "withdraw": Operation(WithdrawJob, Job),
        "recording": Operation(ReadRecording, Recording),
        "verify": Operation(VerifyJob, Verification),
        "balance": Operation(ReadBalance, AccountFunds),
        "statement": Operation(ReadStatement, AccountStatement),
        "answer_consent": Operation(AnswerConsent, Job),
    }
)
"""What programs may ask for, on `DOOR_SOCKET`."""
OWNER: Final[Mapping[str, Operation]] = MappingProxyType(
    {
        "consents": Operation(ListConsents, Consents),
        "approve": Operation(ApproveOrder, Job),
        "deny": Operation(DenyOrder, Job),
        "log": Operation(ReadLog, LogEntries),
        "verify_log": Operation(VerifyLog, LogVerified),
        "policy": Operation(ReadPolicy, PolicyInUse),
        "use_policy": Operation(UsePolicy, PolicyInUse),
    }
)
"""What only the owner may ask for, on `OWNER_SOCKET`."""


class SignerError(AiraError, code="signer-error"):
    """A signer refused a request, or failed at it: `code` is a word for programs, `hint` says what to do.

    `from_strangers` is what a robot or another stranger said about it.
    """

    def __init__(
        self, message: str, *, hint: str = "", code: str = "", from_strangers: StrangersText | None = None
    ) -> None:
        super().__init__(message, hint=hint, code=code)
        self.from_strangers = from_strangers


class SignerUnavailable(SignerError, code="signer-unavailable"):
    """No signer answers on the socket. What was asked may have been done: orders are found by their key."""


class ErrorAnswer(SignerAnswer, frozen=True, kw_only=True):
    """The body of an answer that is an error."""

    error: SignerFailure


class RequestTooLarge(SignerError, code="request-too-large"):
    """A request has more bytes than `LARGEST_REQUEST`."""

    def __init__(self) -> None:
        hint = "put the messages into a file, and give its CID as the objective"
        super().__init__(f"a request has at most {LARGEST_REQUEST} bytes", hint=hint)
