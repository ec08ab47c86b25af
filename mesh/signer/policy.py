"""The policy: what programs may order for a person, in a TOML file of that person. What it does not allow is refused.

Pure: `parse_policy` reads the text, `Policy` judges orders. `read_policy_file` is the one door to the disk, and takes
only a file that nobody else can change.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.amounts import XRT, InvalidAmount, Unit
from mesh.base.hours import Hours
from mesh.errors import ConfigurationError, InputError, nearest
from schemas import parse_address
from schemas.allowed import MOST_VALUES, AllowedTopics, TomlFault, ValueFault
from schemas.cid import is_cid
from schemas.decoding import InvalidData, decode_toml, text_of
from schemas.model import Effort

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from mesh.signer.protocol import Verdict


class SignerPolicyLimits(NamedTuple):
    """What a policy's file may have."""

    size: int = 1 << 18
    """Bytes."""
    rules: int = 1000
    """Tables `[[allow]]`."""


POLICY_LIMITS: Final = SignerPolicyLimits()
ANY: Final = "*"
HOUR, DAY = 3600.0, 86_400.0
"""Seconds of the periods that have a budget. They are the last ones, not those of the calendar."""
_SECTIONS: Final = ("budget", "consent", "allow")
_BUDGET: Final = ("per_job", "per_hour", "per_day", "jobs_at_a_time", "hours")
_CONSENT: Final = ("above", "always", "valid", "by_client")
_ALLOW: Final = ("models", "robots", "topics")
_DURATION: Final = re.compile(r"(?P<count>[0-9]{1,6})\s*(?P<unit>s|min|h|d)")
_UNITS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": DAY}


class InvalidPolicy(ConfigurationError, code="invalid-policy"):
    """A policy has mistakes; `faults` are lines of text, each with its place (`policy.toml:12: …`)."""

    def __init__(self, faults: tuple[str, ...]) -> None:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        super().__init__(f"{faults[0]}{more}", hint="`aira mcp policy check FILE` lists all mistakes")
        self.faults = faults


class Decision(NamedTuple):
    """A verdict. A refusal has a `code`; `why` is a line for people, `next` what to do."""

    verdict: Verdict
    code: str = ""
    why: str = ""
    next: str = ""


class Spending(NamedTuple):
    """What is spent, or bound by orders that are open: the units of the last hour and day, and the open jobs."""

    hour: int
    day: int
    jobs: int


@dataclass(frozen=True, kw_only=True)
class Rule:
    """One `[[allow]]`: its models by its robots on its topics. `None` stands for all."""

    models: frozenset[str] | None
    robots: frozenset[str] | None
    topics: AllowedTopics

    def allows(self, model: str, robot: str) -> bool:
        """Whether it is about a model and a robot; `robot` may be empty while none is chosen."""
        is_robot = not robot or self.robots is None or robot in self.robots
        return (self.models is None or model in self.models) and is_robot


@dataclass(frozen=True, kw_only=True)
class Policy:
    """A policy as it was read. Amounts are in the smallest unit of the token that pays; `valid` is in seconds."""

    hash: str
    unit: Unit
    per_job: int
    per_hour: int
    per_day: int
    jobs_at_a_time: int
    hours: Hours | None
    hours_text: str
    consent_above: int | None
    """Orders of a higher cost need a person's yes; None: none does."""
    valid: float
    """How long a person may take."""
    consent_by_client: bool = False
    """Whether a yes also counts that a program brings, which asked the person by its client. It may not have."""
    rules: tuple[Rule, ...]

    def rules_for(self, model: str, robot: str = "") -> list[Rule]:
        """The rules about a model (CID) and, if it is given, a robot (address)."""
        return [rule for rule in self.rules if rule.allows(model, robot)]

    def refusal_of(self, model: str, robot: str = "") -> Decision | None:
        """Why nothing may be ordered of a model, or of this robot by it; None if something may."""
        if not self.rules_for(model):
            why = f"the policy allows no orders of the model {model}"
            return _refused("model-not-allowed", why, "ask for a model that it allows: see describe_model")
        if not self.rules_for(model, robot):
            return _refused("robot-not-allowed", f"the policy does not allow the robot {robot}", "name another robot")
        return None

    def rules_allowing(
        self, model: str, messages: Iterable[tuple[str, Any]], robot: str = ""
    ) -> tuple[Rule, ...] | Decision:
        """The rules of which each allows all these messages (topics with values of JSON); or why none does."""
        if (refused := self.refusal_of(model, robot)) is not None:
            return refused
        fault: ValueFault | None = None
        left = self.rules_for(model, robot)
        effort = Effort(MOST_VALUES)
        for topic, value in messages:
            for rule in tuple(left):
                try:
                    found = rule.topics.fault(topic, value, effort)
                except InputError as error:
                    return _refused("value-not-allowed", str(error), "order less at a time")
                if found is not None:
                    fault = _telling(fault, found)
                    left.remove(rule)
            if not left and fault is not None:
                hint = "see describe_model for what is allowed; only the owner can change the policy"
                return _refused(fault.code, fault.why, hint)
        return tuple(left)

    def decide(self, cost: int, spending: Spending, now: float, *, has_consent: bool = False) -> Decision:
        """Judge an order of at most this cost, beside what is spent; `now` is Unix time.

        What may be ordered was judged before. With a consent, it needs none.
        """
        shown, owner = self.unit.show, "only the owner can change the policy"
        if self.hours is not None and not self.hours.contain(now):
            return _refused("outside-hours", f"the policy allows orders at {self.hours_text} only", "order then")
        if cost > self.per_job:
            why = f"{shown(cost)} is more than a job may cost, {shown(self.per_job)}"
            return _refused("too-expensive", why, f"order for less; {owner}")
        if spending.jobs >= self.jobs_at_a_time:
            why = f"{spending.jobs} jobs are open, as many as the policy allows at a time"
            return _refused("too-many-jobs", why, "wait for one to end, or stop or withdraw one")
        for code, spent, most, period in (
            ("hour-budget-spent", spending.hour, self.per_hour, "hour"),
            ("day-budget-spent", spending.day, self.per_day, "24 hours"),
        ):
            if spent + cost > most:
                left = shown(max(0, most - spent))
                why = f"{shown(cost)} is more than is left of the budget of the last {period}, {left}"
                return _refused(code, why, f"order for less, or later; {owner}")
        if has_consent or self.consent_above is None or cost <= self.consent_above:
            return Decision("allowed")
        above = self.consent_above
        why = "each order needs a person's yes" if above < 0 else f"orders above {shown(above)} need a person's yes"
        return Decision("needs-consent", "", why, "")

    def words(self) -> tuple[str, ...]:
        """What it allows, in plain words, a line each."""
        show = self.unit.show
        jobs = "1 job" if self.jobs_at_a_time == 1 else f"{self.jobs_at_a_time} jobs"
        lines = [
            f"A job may cost at most {show(self.per_job)}.",
            f"All jobs of any hour may cost at most {show(self.per_hour)}, of any 24 hours {show(self.per_day)}."
            " Refunds don't give this back.",
            f"At most {jobs} may be open at a time.",
            f"Orders are allowed at {self.hours_text}."
            if self.hours is not None
            else "Orders are allowed at any time.",
        ]
        if self.consent_above is None:
            lines.append("No order needs a person's yes.")
        else:
            which = "Each order" if self.consent_above < 0 else f"An order above {show(self.consent_above)}"
            lines.append(f"{which} needs a person's yes, within {_span(self.valid)}.")
            if self.consent_by_client:
                lines.append("The program that orders may bring that yes: nothing proves that it asked a person.")
        for number, rule in enumerate(self.rules, 1):
            models = "any model" if rule.models is None else _listed("the model", "the models", rule.models)
            robots = "any robot" if rule.robots is None else _listed("the robot", "the robots", rule.robots)
            lines.append(f"Rule {number}: {models}, by {robots}, with messages on")
            lines += [f"  - {words}" for words in rule.topics.words()]
        lines.append("Everything else is refused. An order must fit one rule as a whole.")
        return tuple(lines)


def parse_policy(data: bytes, *, unit: Unit = XRT, name: str = "policy.toml") -> Policy:
    """The policy in the text of a file called `name`. Raises `InvalidPolicy` with all its mistakes."""
    try:
        if len(data) > POLICY_LIMITS.size:
            raise InvalidData("too-large", f"it has {len(data)} bytes, more than {POLICY_LIMITS.size}")
        text = text_of(data)
        table = decode_toml(text)
    except InvalidData as error:
        found = re.search(r"at line (\d+)", str(error))
        place = f"{name}:{found[1]}" if found else name
        raise InvalidPolicy((f"{place}: not TOML: {error}",)) from None
    reader = _Reader(unit)
    policy = reader.read(table, hashlib.sha256(data).hexdigest())
    if policy is None:
        lines = sorted((line_of(text, fault.path), fault.why) for fault in reader.faults)
        raise InvalidPolicy(tuple(f"{name}:{line}: {why}" for line, why in lines))
    return policy


def read_policy_file(path: Path) -> bytes:
    """The bytes of a policy's file. Raises `ConfigurationError` if anybody else could have written it, or could.

    It must be a plain file of this user, and no link; neither it nor its folder may be writable by others.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        is_link = path.is_symlink()
        why = "it is a link" if is_link else error.strerror or str(error)
        hint = "name the file itself" if is_link else ""
        raise ConfigurationError(f"can't use the policy {path}: {why}", hint=hint, code="policy-unsafe") from None
    try:
        status, folder = os.fstat(descriptor), path.absolute().parent.stat()
        own = {os.geteuid(), 0}
        is_shared = folder.st_mode & 0o022 and not folder.st_mode & stat.S_ISVTX
        for unsafe, why, hint in (
            (not stat.S_ISREG(status.st_mode), "it is no plain file", "name a file"),
            (status.st_uid not in own, "it belongs to another user", f"`chown {_user()} FILE`, once you have read it"),
            (status.st_mode & 0o022, "others may write to it", "`chmod go-w FILE`, once you have read it"),
            (status.st_nlink > 1, "it has other names (hard links)", "copy it to a file of its own"),
            (folder.st_uid not in own or is_shared, "others may write to its folder", "move it to a folder of yours"),
        ):
            if unsafe:
                raise ConfigurationError(f"can't use the policy {path}: {why}", hint=hint, code="policy-unsafe")
        return os.read(descriptor, POLICY_LIMITS.size + 1)
    finally:
        os.close(descriptor)


def line_of(text: str, path: tuple[str | int, ...]) -> int:
    """The line of a TOML text, counted from 1, in which what is at `path` stands, or what it is in."""
    best, best_length = 1, 0
    here: tuple[str | int, ...] = ()
    lists: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped.startswith("["):
            is_list = stripped.startswith("[[")
            keys = _keys(stripped)
            if keys is None:
                continue
            if is_list:
                lists[keys] = lists.get(keys, -1) + 1
            here = _numbered(keys, lists)
            found = here
        else:
            keys = _keys(f"{stripped.partition('=')[0]}=0") if "=" in stripped else None
            if keys is None:
                continue
            found = (*here, *keys)
        shared = found[: len(path)]
        length = len(found) if found == path[: len(found)] else len(path) if shared == path else 0
        if length > best_length:
            best, best_length = number, length
    return best


def _numbered(keys: tuple[str, ...], lists: Mapping[tuple[str, ...], int]) -> tuple[str | int, ...]:
    """The path of a table, with the numbers of the lists in it."""
    path: list[str | int] = []
    for end in range(1, len(keys) + 1):
        path.append(keys[end - 1])
        if (number := lists.get(keys[:end])) is not None:
            path.append(number)
    return tuple(path)


def _keys(line: str) -> tuple[str, ...] | None:
    """The keys in a line of TOML that is a header, or sets one value."""
    try:
        table: Any = decode_toml(line)
    except InvalidData:
        return None
    keys: list[str] = []
    while isinstance(table, dict) and len(table) == 1:
        ((key, table),) = table.items()
        keys.append(key)
        if isinstance(table, list):
            table = table[0] if table else None
    return tuple(keys) or None


class _Reader:
    """Reads a policy's tables, and collects the mistakes."""

    def __init__(self, unit: Unit) -> None:
        self.unit = unit
        self.faults: list[TomlFault] = []
        self.misspelt: set[str] = set()
        """The keys that unknown ones were likely meant to be."""

    def read(self, table: dict[str, Any], digest: str) -> Policy | None:
        """The policy; None if there are mistakes."""
        self._known(table, _SECTIONS, ())
        budget = self._table(table, "budget", _BUDGET, required=True)
        consent = self._table(table, "consent", _CONSENT)
        amounts = {name: self._amount(budget, ("budget", name)) for name in _BUDGET[:3]}
        jobs = budget.get("jobs_at_a_time", 1)
        if type(jobs) is not int or not 1 <= jobs <= 1000:
            self._fault(("budget", "jobs_at_a_time"), "jobs_at_a_time is a number from 1 to 1000")
        above = self._consent_above(consent)
        valid = self._duration(consent.get("valid", "10 min"), ("consent", "valid"))
        by_client = consent.get("by_client", False)
        if type(by_client) is not bool:
            self._fault(("consent", "by_client"), "by_client is true or false")
        hours = self._hours(budget.get("hours", ""))
        rules = self._rules(table.get("allow"))
        if self.faults:
            return None
        return Policy(
            hash=digest,
            unit=self.unit,
            per_job=amounts["per_job"],
            per_hour=amounts["per_hour"],
            per_day=amounts["per_day"],
            jobs_at_a_time=jobs,
            hours=hours,
            hours_text=budget.get("hours", ""),
            consent_above=above,
            valid=valid,
            consent_by_client=by_client,
            rules=rules,
        )

    def _fault(self, path: tuple[str | int, ...], why: str) -> None:
        self.faults.append(TomlFault(path, why))

    def _known(self, table: Mapping[str, Any], known: tuple[str, ...], path: tuple[str | int, ...]) -> None:
        for key in table:
            if key not in known:
                if near := nearest(key, known):
                    self.misspelt.add(near)
                said = f"unknown: {key!a}" + (f"; did you mean {near}?" if near else f"; there is {_any_of(known)}")
                self._fault((*path, key), said)

    def _table(
        self, table: dict[str, Any], name: str, known: tuple[str, ...], *, required: bool = False
    ) -> dict[str, Any]:
        found = table.get(name)
        if found is None and not required:
            return {}
        if not isinstance(found, dict):
            self._fault((name,), f"the table [{name}] is missing" if found is None else f"{name} is a table: [{name}]")
            return {}
        self._known(found, known, (name,))
        return found

    def _amount(self, table: dict[str, Any], path: tuple[str, ...]) -> int:
        name = path[-1]
        if name not in table:
            if name in self.misspelt:
                return 0  # that was said
            self._fault(path, f'{name} is missing: as in {name} = "5 XRT"')
            return 0
        value = table[name]
        if not isinstance(value, str):
            self._fault(path, f'{name} is a text with its unit: {name} = "5 XRT"')
            return 0
        try:
            return self.unit.parse(value)
        except InvalidAmount as error:
            self._fault(path, f"{name}: {error}")
            return 0

    def _consent_above(self, table: dict[str, Any]) -> int | None:
        """The cost above which a person must say yes; -1 for all orders, None for none."""
        always = table.get("always", False)
        if type(always) is not bool:
            self._fault(("consent", "always"), "always is true or false")
        if "above" in table and always is True:
            self._fault(("consent", "above"), "say either above or always = true")
        if always is True:
            return -1
        if "above" in table:
            return self._amount(table, ("consent", "above"))
        if table:
            self._fault(("consent",), 'say above = "2 XRT", or always = true')
        return None

    def _duration(self, value: object, path: tuple[str, ...]) -> float:
        found = _DURATION.fullmatch(value.strip()) if isinstance(value, str) else None
        seconds = int(found["count"]) * _UNITS[found["unit"]] if found else 0.0
        if not 10.0 <= seconds <= DAY:
            self._fault(path, 'valid is from 10 s to 1 d, as in "10 min"')
        return seconds

    def _hours(self, value: object) -> Hours | None:
        if value == "":
            return None
        try:
            if not isinstance(value, str):
                raise ValueError("it is no text")
            return Hours.parse(value)
        except ValueError as error:
            self._fault(("budget", "hours"), f"hours: {error}")
            return None

    def _rules(self, found: object) -> tuple[Rule, ...]:
        if found is None:
            self._fault((), "nothing is allowed: write [[allow]] with models, robots and topics")
            return ()
        most = POLICY_LIMITS.rules
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found) or len(found) > most:
            self._fault(("allow",), f"write [[allow]], in double brackets, for each rule, {most} at most")
            return ()
        return tuple(self._rule(one, ("allow", number)) for number, one in enumerate(found))

    def _rule(self, table: dict[str, Any], path: tuple[str | int, ...]) -> Rule:
        self._known(table, _ALLOW, path)
        topics = AllowedTopics({})
        if "topics" in table:
            topics = AllowedTopics.read(table["topics"], (*path, "topics"), self.faults)
        if not topics.topics and not any(fault.path[: len(path)] == path for fault in self.faults):
            self._fault(path, 'this rule allows no topic: write [allow.topics."/drive"] below it')
        return Rule(models=self._names(table, "models", path), robots=self._names(table, "robots", path), topics=topics)

    def _names(self, table: dict[str, Any], name: str, path: tuple[str | int, ...]) -> frozenset[str] | None:
        """CIDs or addresses; None for `*`."""
        what = "the CIDs of models" if name == "models" else "the addresses of robots"
        place, values = (*path, name), table.get(name)
        if not isinstance(values, list) or not values or not all(isinstance(one, str) for one in values):
            self._fault(place if values is not None else path, f'{name} is a list of {what}, or ["*"]')
            return frozenset()
        if values == [ANY]:
            return None
        found = set()
        for value in values:
            if name == "models" and is_cid(value):
                found.add(value)
            elif name == "robots" and value[:2] == "0x":
                try:
                    found.add(parse_address(value))
                except InputError as error:
                    self._fault(place, str(error))
            else:
                self._fault(place, f'{value[:80]!a} is not one of {what}; ["*"] alone is any')
        return frozenset(found)


def _refused(code: str, why: str, hint: str) -> Decision:
    return Decision("refused", code, why, hint)


def _telling(before: ValueFault | None, found: ValueFault) -> ValueFault:
    """The fault that says more: a wrong value more than a wrong field, and that more than a wrong topic."""
    order = ("topic-not-allowed", "field-not-allowed", "value-not-allowed")
    return found if before is None or order.index(found.code) > order.index(before.code) else before


def _listed(one: str, several: str, names: frozenset[str]) -> str:
    return f"{one if len(names) == 1 else several} {', '.join(sorted(names))}"


def _any_of(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def _span(seconds: float) -> str:
    for unit, length in (("hour", 3600.0), ("minute", 60.0)):
        if seconds >= length and seconds % length == 0:
            count = round(seconds / length)
            return f"{count} {unit}{'' if count == 1 else 's'}"
    return f"{seconds:g} seconds"


def _user() -> str:
    import pwd

    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())
