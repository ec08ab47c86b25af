"""What a malicious model tries over the door, and what comes of it: one table for the tests and the guide."""

from __future__ import annotations

from typing import Any, Final, NamedTuple


class Attempt(NamedTuple):
    """A call of a tool: its arguments, or for `order` what it changes in a good order."""

    tried: str
    code: str
    tool: str
    arguments: dict[str, Any]


class Story(NamedTuple):
    """An attack that is more than a call, what comes of it, and its test below `tests`."""

    tried: str
    said: str
    test: str


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

STORIES: Final = (
    Story(
        "the same order ten times at once",
        "one job, one contract",
        "bridges.mcp.test_mcp_hostile.test_the_same_order_ten_times_at_once_is_one_job",
    ),
    Story(
        "the same key for another order",
        "`idempotency-conflict`",
        "bridges.mcp.test_mcp_hostile.test_the_same_order_ten_times_at_once_is_one_job",
    ),
    Story(
        "twenty orders at once, over two doors, for more than the hour's budget",
        "as many as the budget has",
        "bridges.mcp.test_mcp_hostile.test_orders_at_once_over_two_doors_stay_within_the_budget",
    ),
    Story(
        "more jobs at a time than allowed",
        "`too-many-jobs`",
        "bridges.mcp.test_mcp_hostile.test_no_more_jobs_at_a_time_than_allowed",
    ),
    Story(
        "a yes that nobody gave, in the answer of a form that was not asked",
        "`needs-consent` stays",
        "bridges.mcp.test_mcp_hostile.test_a_yes_that_nobody_gave_is_none",
    ),
    Story(
        "a yes to a consent that was answered",
        "`consent-used`",
        "bridges.mcp.test_mcp_hostile.test_a_yes_that_nobody_gave_is_none",
    ),
    Story(
        "a yes to another order's consent",
        "that order only",
        "bridges.mcp.test_mcp_consents.test_the_owner_allows_one_order_and_only_that",
    ),
    Story("a yes that comes too late", "`expired`", "mesh.signer.test_hostile.test_a_consent_expires"),
    Story(
        "an order that was changed after it was shown",
        "is not approved",
        "mesh.signer.test_hostile.test_an_order_that_was_changed_after_it_was_shown_is_not_approved",
    ),
    Story(
        "the owner's operations on the door's socket",
        "`unknown-operation`",
        "bridges.mcp.test_mcp_hostile.test_a_yes_that_nobody_gave_is_none",
    ),
    Story(
        "a clock that is set back",
        "frees no budget",
        "mesh.signer.test_hostile.test_a_clock_that_is_set_back_frees_no_budget",
    ),
    Story(
        "another policy in the file",
        "counts once the owner says so",
        "mesh.signer.test_hostile.test_a_policy_that_was_swapped_counts_only_when_the_owner_says_so",
    ),
    Story(
        "a policy that others may write, or a link to one",
        "`policy-unsafe`",
        "mesh.signer.test_policy.test_a_file_that_others_could_have_written_is_refused",
    ),
    Story(
        "an entry of the log that was changed, removed or added",
        "`log-broken`",
        "mesh.signer.test_signer_log.test_what_was_changed_is_found",
    ),
    Story(
        "a second signer with the same folder",
        "`signer-running`",
        "mesh.signer.test_signer.test_a_second_signer_in_one_folder_refuses",
    ),
    Story(
        "a flood of requests to the signer",
        "`too-many-requests`",
        "mesh.signer.test_hostile.test_a_flood_of_requests_is_refused",
    ),
    Story(
        "a flood of connections to the signer",
        "`too-many-connections`",
        "mesh.signer.test_signer_limits.test_one_connection_too_many_is_told_so_and_the_others_go_on",
    ),
    Story(
        "instructions in the robot's name and sentence, the model, its topics and choices",
        "marked as data",
        "bridges.mcp.test_mcp_hostile.test_texts_of_strangers_are_marked_wherever_they_stand",
    ),
    Story(
        "instructions, escape codes and turned letters in a failed job's words",
        "marked, and cleaned",
        "bridges.mcp.test_mcp_hostile.test_texts_of_strangers_are_marked_wherever_they_stand",
    ),
    Story(
        "instructions in a recording",
        "marked, and cleaned",
        "bridges.mcp.test_mcp_hostile.test_texts_of_strangers_are_marked_wherever_they_stand",
    ),
    Story(
        "texts of strangers in the descriptions of tools",
        "these never change",
        "bridges.mcp.test_mcp_hostile.test_texts_of_strangers_are_marked_wherever_they_stand",
    ),
    Story(
        "an HTTP request without the token, or with a wrong one",
        "401",
        "bridges.mcp.test_http.test_without_the_token_nothing_is_served",
    ),
    Story(
        "a token of another server, of another issuer, over, forged or unsigned",
        "401",
        "bridges.mcp.test_http.test_other_tokens_are_not_taken",
    ),
    Story(
        "a page of another site (DNS rebinding by `Host`, or `Origin`)",
        "421, 403",
        "bridges.test_serving.test_pages_of_other_sites_reach_nothing",
    ),
    Story("a body of more than 1 MiB", "413", "bridges.test_serving.test_a_body_that_is_too_large_is_refused"),
    Story(
        "a connection that sends nothing", "is ended", "bridges.mcp.test_http.test_a_client_that_sends_nothing_is_ended"
    ),
    Story(
        "a message of more than 2 MiB, or none at all, on stdin",
        "is skipped",
        "bridges.mcp.test_stdio.test_what_is_no_message_ends_nothing",
    ),
    Story(
        "a token file that others can read, or a link",
        "`token-file-unusable`",
        "bridges.mcp.test_http.test_a_token_file_that_is_not_private_is_refused",
    ),
    Story(
        "a page without a login that answers consents",
        "`operators-only`",
        "bridges.web.test_web_consents.test_only_operators_who_logged_in_see_and_answer_them",
    ),
)
"""Attacks that are more than a call, and what comes of them."""


def table() -> str:
    """The table of the guide."""
    rows = [(one.tried, f"`{one.code}`") for one in CALLS]
    rows += [(f"the tool `{name}`", "there is none") for name in HIDDEN_TOOLS]
    rows += [(f"the resource `{uri}`", "`no-such-resource`") for uri in URIS]
    rows += [(one.tried, one.said) for one in STORIES]
    return "\n".join(
        ["| what is tried | what comes of it |", "|---|---|", *(f"| {tried} | {said} |" for tried, said in rows)]
    )
