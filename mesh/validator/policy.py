"""What a policy is, how its options are written, and how a function becomes one."""

from __future__ import annotations

import contextvars
import inspect
import logging
import threading
from concurrent.futures import Future
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError
from mesh.evidence import Finding
from mesh.log_context import log_event
from schemas.errors import InvalidRecord
from schemas.verdicts import MOST_FINDINGS, PolicyNote

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from typing import TypeAlias

    from mesh.validator.evidence import Evidence, JudgedMessage

    Outcome: TypeAlias = "bool | str | Finding | Iterable[Finding | str] | None"
    CheckFunction: TypeAlias = "Callable[[Evidence], Outcome]"

log = logging.getLogger(__name__)

CHECK_TIMEOUT: Final = "check-timeout"
"""The code of an own check that took too long: the work then neither counts nor fails."""
MOST_OVERDUE: Final = 4
"""Own checks that may go on after their time in one process; while there are so many, no other one is begun."""
_UNITS: Final = (("ms", 10**6), ("s", 10**9), ("m", 60 * 10**9), ("h", 3600 * 10**9))


class InvalidPolicy(ConfigurationError, code="invalid-policy"):
    """A policy has an unknown name or option, or a wrong value. `policy` is what was given."""

    def __init__(self, policy: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"the policy {policy!r}: {why}", hint=hint)
        self.policy = policy


class PolicyCheck:
    """A policy at work on one recording. This one demands nothing."""

    def add(self, message: JudgedMessage) -> None:
        """Look at the next message of the recording."""

    def findings(self) -> Iterator[Finding]:
        """What was found, once all messages are added. The work counts only if all of it holds."""
        yield from ()


@dataclass(frozen=True)
class Policy:
    """What a recording must show: `name` is a word for programs, `description` one sentence for people."""

    name: str
    description: str

    def __post_init__(self) -> None:
        try:
            PolicyNote(name=self.name, description=self.description)
        except InvalidRecord as error:
            raise InvalidPolicy(self.name, str(error)) from None

    @property
    def note(self) -> PolicyNote:
        """The policy as its validator announces it."""
        return PolicyNote(name=self.name, description=self.description)

    def begin(self, evidence: Evidence) -> PolicyCheck:
        """Begin to check a recording."""
        return PolicyCheck()


class PolicyOptions:
    """The options of a policy, as written after its name: `acknowledged:command=/lamp:within=2s`."""

    def __init__(self, text: str) -> None:
        self.text: Final = text
        self.name, *options = text.strip().split(":")
        pairs = [option.partition("=") for option in options]
        if not all(name and equals and value for name, equals, value in pairs):
            raise InvalidPolicy(text, "options are written name=value", hint=f"for example {self.name}:within=2s")
        self._values = {name: value for name, _, value in pairs}
        if len(self._values) < len(pairs):
            raise InvalidPolicy(text, "an option is given twice")

    def text_of(self, name: str) -> str:
        """A text; empty if it is not given."""
        return self._values.pop(name, "")

    def number_of(self, name: str) -> float | None:
        """A positive number; None if it is not given."""
        value = self._values.pop(name, None)
        try:
            number = None if value is None else float(value)
        except ValueError:
            number = 0.0
        if number is not None and not 0 < number < float("inf"):
            raise InvalidPolicy(self.text, f"{name} must be a positive number, not {value!r}")
        return number

    def time_of(self, name: str, default_ns: int) -> int:
        """A time in nanoseconds, written with its unit: 500ms, 1s, 2m, 1h."""
        value = self._values.pop(name, None)
        if value is None:
            return default_ns
        for unit, factor in _UNITS:
            amount = value.removesuffix(unit)
            if amount != value and amount.replace(".", "", 1).isdecimal() and 0 < float(amount) < 10**6:
                return round(float(amount) * factor)
        raise InvalidPolicy(self.text, f"{name} must be a time such as 500ms, 1s or 2m, not {value!r}")

    def check_all_used(self, *known: str) -> None:
        """Raise `InvalidPolicy` if there are other options than the `known` ones."""
        if self._values:
            name, hint = min(self._values), f"its options: {', '.join(known)}" if known else "it has no options"
            raise InvalidPolicy(self.text, f"it has no option {name!r}", hint=hint)


@dataclass(frozen=True)
class OwnPolicy(Policy):
    """A policy by a function of a user, which gets the `Evidence` and says whether it holds.

    It returns True or an empty text if it holds, False or a text that says why if it does not, None if it can't decide
    (then the work does not count), or yields `Finding`s and texts. An exception also counts as undecided. If it takes
    more than `timeout` seconds, the result is not judged, unless another finding fails.
    """

    function: CheckFunction
    timeout: float = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.timeout <= threading.TIMEOUT_MAX:
            raise InvalidPolicy(self.name, f"its timeout must be a positive number of seconds, not {self.timeout}")
        if inspect.iscoroutinefunction(self.function):
            raise InvalidPolicy(self.name, "a check is a plain function, which runs in a thread")

    def begin(self, evidence: Evidence) -> PolicyCheck:
        """Begin to check a recording."""
        return _OwnCheck(self, evidence)


class _OwnCheck(PolicyCheck):
    def __init__(self, policy: OwnPolicy, evidence: Evidence) -> None:
        self._policy = policy
        self._evidence = evidence

    def findings(self) -> Iterator[Finding]:
        name = self._policy.name
        try:
            yield from _found_in_time(self._policy, self._evidence)
        except _CheckOverdueError as overdue:
            yield Finding(CHECK_TIMEOUT, None, str(overdue))
        except (Exception, SystemExit) as error:  # of a user's function
            facts = log_event("policy-check-failed", policy=name)
            log.exception("the check of the policy %s failed", name, extra=facts)
            yield Finding(
                "check-failed", None, f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            )


class _CheckOverdueError(Exception):
    """A user's function did not end in time, or was not begun because others have not."""


_overdue: Final[set[threading.Thread]] = set()


def _found_in_time(policy: OwnPolicy, evidence: Evidence) -> list[Finding]:
    """What a user's function finds. Raises what it raises, and `_CheckOverdueError`.

    Nothing can stop a thread from outside: a function whose time is over goes on, and the number of those is bounded.
    """
    _overdue.difference_update([thread for thread in tuple(_overdue) if not thread.is_alive()])
    if len(_overdue) >= MOST_OVERDUE:
        raise _CheckOverdueError(f"it was not begun: {len(_overdue)} earlier checks have not ended")
    context, outcome = contextvars.copy_context(), Future[list[Finding]]()

    def run() -> None:
        try:
            outcome.set_result(context.run(lambda: list(_findings_of(policy.function(evidence), policy))))
        except BaseException as error:
            outcome.set_exception(error)

    thread = threading.Thread(target=run, name=f"check {policy.name}", daemon=True)
    thread.start()
    thread.join(policy.timeout)
    if thread.is_alive():
        _overdue.add(thread)
        raise _CheckOverdueError(f"it did not end within {policy.timeout:g} s")
    return outcome.result()


def _findings_of(outcome: Outcome, policy: OwnPolicy) -> Iterator[Finding]:
    """The findings in what a user's function returns, or yields: at most as many as a report holds."""
    match outcome:
        case True | "":
            yield Finding("check", True, policy.description)
        case False:
            yield Finding("check", False, f"it does not hold: {policy.description}")
        case None:
            yield Finding("check", None, "the check did not decide")
        case str():
            yield Finding("check", False, outcome)
        case Finding():
            yield outcome
        case _:
            found = list(islice(outcome, MOST_FINDINGS))
            for one in found:
                yield one if isinstance(one, Finding) else Finding("check", False, str(one))
            if not found:
                yield Finding("check", True, policy.description)
