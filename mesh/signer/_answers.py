"""Building answers from what the mesh knows: strangers' texts made harmless, models as fields, amounts."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from mesh.recording import shown_value
from mesh.signer import protocol
from mesh.signer._kept import time_text
from mesh.signer.protocol import StrangersText
from schemas.model import PRICE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from mesh.amounts import Unit
    from mesh.recording import Objective, Played
    from mesh.signer.policy import Rule
    from mesh.watching import Robot
    from schemas.allowed import ValueRule
    from schemas.model import ModelDescription, ModelTopic, ValueSchema


class SignerAnswerLimits(NamedTuple):
    """How much of what strangers write an answer of the signer shows."""

    text: int = 300
    """Characters of a text."""
    value: int = 4096
    """Characters of a value."""
    name: int = 64
    """Characters of a name, a unit or a choice in a model."""
    payload: int = 65_536
    """Bytes of a latest or last value that is shown."""
    topics: int = 256
    """Topics of a recording that are listed."""
    fields: int = 200
    """Fields of a topic of a model."""


SIGNER_ANSWER_LIMITS: Final = SignerAnswerLimits()
_HIDDEN: Final = frozenset({"Cc", "Cf", "Cn", "Co", "Cs", "Zl", "Zp"})


def plain(text: str, longest: int = SIGNER_ANSWER_LIMITS.text) -> str:
    """A text on one line without characters that are invisible, or change how others are shown."""
    spaced = "".join(" " if one.isspace() else "" if unicodedata.category(one) in _HIDDEN else one for one in text)
    shown = " ".join(spaced.split())
    return shown if len(shown) <= longest else shown[: longest - 1] + "…"


def strangers(text: str, author: str, longest: int = SIGNER_ANSWER_LIMITS.text) -> StrangersText:
    """A text of a stranger, as answers have it; `author` is like `robot 0x…`."""
    return StrangersText(text=plain(text[: 8 * longest], longest), author=author)


def amount(unit: Unit, units: int) -> protocol.Amount:
    """An amount of the smallest unit."""
    return protocol.Amount(text=unit.show(units), units=int(units))


def found_robot(robot: Robot, model: ModelDescription | None, *, is_allowed: bool) -> protocol.FoundRobot:
    """A robot that is present."""
    author = f"robot {robot.address}"
    record = None
    if robot.paid is not None and robot.refunded is not None:
        record = protocol.RobotRecord(jobs=robot.paid + robot.refunded, paid=robot.paid, refunded=robot.refunded)
    title = None if model is None else strangers(model.title, f"model {robot.model}")
    return protocol.FoundRobot(
        address=robot.address,
        name=strangers(robot.name, author),
        sentence=strangers(robot.about, author),
        models=(protocol.RobotModel(cid=robot.model, title=title),) if robot.model else (),
        price=robot.price if re.fullmatch(PRICE, robot.price) else "",  # it may write anything there
        state=robot.state,
        queue=robot.queue,
        wait_seconds=robot.wait,
        record=record,
        on_stop="" if model is None else model.on_stop,
        is_allowed=is_allowed,
    )


def described_model(cid: str, model: ModelDescription | None, rules: list[Rule]) -> protocol.DescribedModel:
    """A model, and what the rules of a policy about it allow."""
    if model is None:
        return protocol.DescribedModel(model=cid, is_allowed=bool(rules), has_description=False)
    author = f"model {cid}"
    return protocol.DescribedModel(
        model=cid,
        is_allowed=bool(rules),
        has_description=True,
        title=strangers(model.title, author),
        description=strangers(model.description, author, 1000),
        success=strangers(model.success, author, 1000),
        topics=tuple(_topic(topic, rules, author) for topic in model.objective),
        results=tuple(_topic(topic, [], author) for topic in model.result),
        price=model.price,
        seconds=None if model.seconds is None else float(model.seconds),
        on_stop=model.on_stop,
    )


def _topic(topic: ModelTopic, rules: list[Rule], author: str) -> protocol.DescribedTopic:
    allowed = [found for rule in rules if (found := rule.topics.value(topic.topic)) is not None]
    by_path = [dict(one.rules()) for one in allowed]
    fields = [] if topic.value is None else list(_fields("", topic.value, by_path, author, is_required=True))
    return protocol.DescribedTopic(
        topic=plain(topic.topic, 200),
        title=strangers(topic.title, author) if topic.title else None,
        description=strangers(topic.description, author) if topic.description else None,
        fields=tuple(fields[: SIGNER_ANSWER_LIMITS.fields]),
        is_required=topic.required,
        max_messages=topic.max_messages,
        is_allowed=bool(allowed),
    )


def _fields(
    path: str, schema: ValueSchema, allowed: list[dict[str, ValueRule]], author: str, *, is_required: bool
) -> Iterator[protocol.ModelField]:
    if schema.type == "object":
        for name, inner in schema.properties.items():
            if name.isascii():
                inner_path = f"{path}.{name}" if path else name
                yield from _fields(inner_path, inner, allowed, author, is_required=name in schema.required)
        return
    if schema.type == "array" and schema.items is not None:
        yield from _fields(f"{path}[]", schema.items, allowed, author, is_required=is_required)
        return
    if schema.type == "null" and not path:
        return
    yield protocol.ModelField(
        path=path[:200],
        type=schema.type,
        title=strangers(schema.title, author) if schema.title else None,
        unit=plain(schema.unit, SIGNER_ANSWER_LIMITS.name),
        minimum=schema.minimum if schema.minimum is not None else schema.exclusive_minimum,
        maximum=schema.maximum if schema.maximum is not None else schema.exclusive_maximum,
        choices=tuple(
            plain(one, SIGNER_ANSWER_LIMITS.name) if isinstance(one, str) else one for one in schema.enum[:50]
        ),
        is_required=is_required,
        allowed=tuple(
            protocol.FieldAllowed(minimum=rule.minimum, maximum=rule.maximum, choices=rule.one_of)
            for rules in allowed
            if (rule := rules.get(path)) is not None
        ),
    )


def value_text(message: Played, author: str, longest: int = SIGNER_ANSWER_LIMITS.value) -> tuple[StrangersText, bool]:
    """The value of a message in JSON, and whether it was shortened."""
    value, is_cut = shown_value(message)
    text = value if is_cut and isinstance(value, str) else msgspec.json.encode(value).decode()
    return strangers(text, author, longest), is_cut or len(text) > longest


def recorded(objective: Objective, cid: str, author: str, asked: protocol.ReadRecording) -> protocol.Recording:
    """What a recording has. Blocks on the disk."""
    topics: Counter[tuple[str, str]] = Counter()
    last: dict[tuple[str, str], Played | None] = {}
    values: list[protocol.RecordedValue] = []
    count = 0
    for message in objective.messages():
        place = message.topic, message.type.zenoh_encoding
        if place in topics or len(topics) < SIGNER_ANSWER_LIMITS.topics:
            topics[place] += 1
            last[place] = message if len(message.payload) <= SIGNER_ANSWER_LIMITS.payload else None
        if asked.topic and message.topic == asked.topic:
            if asked.first <= count < asked.first + asked.limit:
                text, is_cut = value_text(message, author)
                moment = time_text(message.log_time_ns / 1e9)
                values.append(protocol.RecordedValue(time=moment, value=text, is_shortened=is_cut))
            count += 1
    return protocol.Recording(
        cid=cid,
        duration_seconds=objective.duration_ns / 1e9,
        messages=objective.count,
        topics=()
        if asked.topic
        else tuple(
            protocol.RecordedTopic(
                topic=strangers(place[0], author),
                encoding=strangers(place[1], author),
                messages=topics[place],
                last=None if message is None else value_text(message, author, SIGNER_ANSWER_LIMITS.text)[0],
            )
            for place, message in last.items()
        ),
        values=tuple(values),
        more=max(0, count - asked.first - len(values)),
    )


def message_lines(messages: Iterable[tuple[str, Any]], author: str) -> tuple[list[StrangersText], int]:
    """The first messages of an order, a line each for people, and how many more there are."""
    lines: list[StrangersText] = []
    count = 0
    for topic, value in messages:
        count += 1
        if len(lines) < 20:
            text = "…" if isinstance(value, bytes) else msgspec.json.encode(value).decode()
            lines.append(strangers(f"{topic} {text}", author))
    return lines, count - len(lines)
