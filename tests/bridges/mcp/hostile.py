"""What a malicious model tries over the door, and what comes of it: one table for the tests and the guide."""

from __future__ import annotations

from typing import Any, Final, NamedTuple


class Attempt(NamedTuple):
    """A call of a tool: its arguments, or for `order` what it changes in a good order."""

    tried: str
    code: str
    tool: str
    arguments: dict[str, Any]


def value(**fields: Any) -> dict[str, Any]:
    """An order of one message with other fields."""
    return {"messages": [{"topic": "/count", "value": {"count": 1, "mode": "fine"} | fields}]}


def sent(fields: dict[str, Any]) -> dict[str, Any]:
    """An order of one message that has these fields."""
    return {"messages": [{"topic": "/count"} | fields]}


def nested(depth: int) -> Any:
    found: Any = 1
    for _ in range(depth):
        found = [found]
    return found


JOB: Final = "job-0123456789abcdef"
OTHER: Final = "0x000000000000000000000000000000000000bEEF"
CALLS: Final = (
    Attempt("an order without a key", "invalid-request", "order", {"idempotency_key": ""}),
    Attempt("a key of 129 characters", "invalid-request", "order", {"idempotency_key": "k" * 129}),
    Attempt("an argument that there is not: `approved`", "invalid-request", "order", {"approved": True}),
    Attempt("an argument with the consent", "invalid-request", "order", {"consent": "consent-0123456789abcdef"}),
    Attempt("a cost that is a number", "invalid-request", "order", {"cost": 900}),
    Attempt("a cost of no token", "invalid-amount", "order", {"cost": "many"}),
    Attempt("a cost of 900 XRT", "too-expensive", "order", {"cost": "900 XRT"}),
    Attempt("a negative cost", "invalid-amount", "order", {"cost": "-1 XRT"}),
    Attempt("a deadline in the past", "invalid-request", "order", {"deadline_seconds": -1}),
    Attempt("a deadline of 10^30 seconds", "invalid-request", "order", {"deadline_seconds": 10**30}),
    Attempt("1,001 messages", "invalid-request", "order", {"messages": [{"topic": "/count", "value": 1}] * 1001}),
    Attempt("messages as a text that is no JSON", "invalid-request", "order", {"messages": "rm -rf /"}),
    Attempt("messages as a text nested 10,000 deep", "invalid-request", "order", {"messages": "[" * 10_000}),
    Attempt("a value nested 60 deep", "value-not-allowed", "order", sent({"value": nested(60)})),
    Attempt("a value of 500,000 characters", "value-not-allowed", "order", value(mode="x" * 500_000)),
    Attempt("a message with a field of its own", "invalid-request", "order", sent({"price": 0})),
    Attempt("a model that is a list", "invalid-request", "order", {"model": ["*"]}),
    Attempt("a note of 10,000 characters", "invalid-request", "order", {"note": "!" * 10_000}),
    Attempt("a robot that the policy does not have", "robot-not-allowed", "order", {"robot": OTHER}),
    Attempt("a value above the policy's range", "value-not-allowed", "order", value(count=11)),
    Attempt("a value below the policy's range", "value-not-allowed", "order", value(count=-1)),
    Attempt("a value that only the model allows", "value-not-allowed", "order", value(mode="coarse")),
    Attempt("a choice with a Cyrillic letter", "value-not-allowed", "order", value(mode="f\u0456ne")),
    Attempt("a choice with letters that turn the text around", "value-not-allowed", "order", value(mode="\u202eenif")),
    Attempt("a field that the policy does not have", "field-not-allowed", "order", value(speed=99)),
    Attempt(
        "a topic that the policy does not have",
        "topic-not-allowed",
        "order",
        {"messages": [{"topic": "/arm", "value": {"count": 1, "mode": "fine"}}]},
    ),
    Attempt("an objective that is a path", "invalid-cid", "order", {"messages": [], "objective": "../../etc/passwd"}),
    Attempt("50,000 robots at a time", "invalid-request", "find_robots", {"limit": 50_000}),
    Attempt("-1 robots", "invalid-request", "find_robots", {"limit": -1}),
    Attempt("a number as a text", "invalid-request", "find_robots", {"limit": "5"}),
    Attempt("a search of 1 MB", "invalid-request", "find_robots", {"text": "x" * 1_000_000}),
    Attempt("a model that is a path", "invalid-cid", "describe_model", {"model": "../../../etc/passwd"}),
    Attempt("a job that is a path", "invalid-request", "job", {"job_id": "../signer/budget.sqlite"}),
    Attempt("a job of somebody else", "unknown-job", "job", {"job_id": JOB}),
    Attempt("waiting for a year", "invalid-request", "job", {"job_id": JOB, "wait_seconds": 3e7}),
    Attempt("stopping a job of somebody else", "unknown-job", "stop_job", {"job_id": JOB}),
    Attempt("withdrawing an order of somebody else", "unknown-job", "withdraw", {"job_id": JOB}),
    Attempt("the recording of a job of somebody else", "unknown-job", "recording", {"job_id": JOB}),
    Attempt("10^9 values of a recording", "invalid-request", "recording", {"job_id": JOB, "limit": 10**9}),
    Attempt("verifying a job that there is not", "unknown-job", "verify", {"job_id": JOB}),
    Attempt("a statement of 10^9 entries", "invalid-request", "statement", {"limit": 10**9}),
    Attempt("a balance of another account", "invalid-request", "balance", {"account": OTHER}),
)
"""Calls that are refused, each with no order and no wn more than before."""

HIDDEN_TOOLS: Final = ("approve", "deny", "answer_consent", "use_policy", "policy", "consents", "log", "verify_log")
"""Operations of the signer that are no tools."""

URIS: Final = (
    "file:///etc/passwd",
    "aira://../../etc/passwd",
    "aira://market/../../signer/owner.sock",
    "aira://robot/0x0000000000000000000000000000000000000000/../../x",
    "aira://robot/%2e%2e%2f%2e%2e%2fetc%2fpasswd",
    "aira://recording/job-0123456789abcdeg",
    "aira://recording/../budget.sqlite",
    "aira://contract/0x",
    "aira://policy",
    "http://127.0.0.1:8545/",
)
"""Resources that there are not."""

STORIES: Final = {
    "the same order ten times at once": "one job, one contract",
    "the same key for another order": "`idempotency-conflict`",
    "twenty orders at once, over two doors, for more than the hour's budget": "as many as the budget has",
    "more jobs at a time than allowed": "`too-many-jobs`",
    "a yes that nobody gave, in the answer of a form that was not asked": "`needs-consent` stays",
    "a yes to a consent that was answered": "`consent-used`",
    "a yes to another order's consent": "that order only",
    "the owner's operations on the door's socket": "`unknown-operation`",
    "instructions in the robot's name and sentence, the model, its topics and choices": "marked as data",
    "instructions, escape codes and turned letters in a failed job's words": "marked, and cleaned",
    "instructions in a recording": "marked, and cleaned",
    "texts of strangers in the descriptions of tools": "these never change",
    "an HTTP request without the token, or with a wrong one": "401",
    "a token of another server, of another issuer, over, forged or unsigned": "401",
    "a page of another site (DNS rebinding by `Host`, or `Origin`)": "421, 403",
    "a body of more than 1 MiB": "413",
    "a connection that sends nothing": "is ended",
    "a message of more than 2 MiB, or none at all, on stdin": "is skipped",
    "a token file that others can read, or a link": "`token-file-unusable`",
    "a page without a login that answers consents": "`operators-only`",
}
"""Attacks that are more than a call, and what comes of them; each has a test of its own."""


def table() -> str:
    """The table of the guide."""
    rows = [(one.tried, f"`{one.code}`") for one in CALLS]
    rows += [(f"the tool `{name}`", "there is none") for name in HIDDEN_TOOLS]
    rows += [(f"the resource `{uri}`", "`no-such-resource`") for uri in URIS]
    rows += list(STORIES.items())
    return "\n".join(
        ["| what is tried | what comes of it |", "|---|---|", *(f"| {tried} | {said} |" for tried, said in rows)]
    )
