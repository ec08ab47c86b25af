"""The policy `schema`: what the device sent is of its declared types, and within their limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.evidence import Finding
from mesh.validator.policy import Policy, PolicyCheck
from schemas.errors import InvalidPayload
from schemas.payloads import RAW
from schemas.value_schema import MAX_DEPTH, Effort, TooManyValues, ValueSchema

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.validator.evidence import Evidence, JudgedMessage
    from schemas.model import ModelDescription
    from schemas.payloads import PayloadType

_MOST_VALUES: Final = 5_000_000
"""Values in arrays and objects of one recording that are checked, which takes about five seconds."""
_LONGEST_SCHEMA: Final = 64 << 10
_NUMBERS: Final = frozenset({"minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"})
_OF_TYPE: Final = {
    "null": frozenset[str](),
    "boolean": frozenset[str](),
    "integer": _NUMBERS | {"enum"},
    "number": _NUMBERS,
    "string": frozenset({"enum", "minLength", "maxLength"}),
    "array": frozenset({"minItems", "maxItems"}),
    "object": frozenset[str](),
}
"""The keywords of JSON Schema that are checked, by type, besides `items`, `properties` and `required`."""


class SchemaPolicy(Policy):
    """Each message of the device fits its type, its JSON Schema and what the model says of results."""

    def begin(self, evidence: Evidence) -> PolicyCheck:
        """Begin to check a recording."""
        return _SchemaCheck(evidence.model)


SCHEMA: Final = SchemaPolicy(
    "schema",
    "Each message of the device is of its declared type, its numbers are finite, and within the limits of its schema "
    "and of the model.",
)


@dataclass
class _SchemaCheck(PolicyCheck):
    model: ModelDescription | None
    faults: dict[str, tuple[str, int]] = field(default_factory=dict)
    """The first fault of each kind, and how many there are."""
    heard: set[str] = field(default_factory=set)
    effort: Effort = field(default_factory=lambda: Effort(_MOST_VALUES))
    count: int = 0

    def add(self, message: JudgedMessage) -> None:
        if message.role != "device":
            return
        self.count += 1
        self.heard.add(message.topic)
        try:
            found = self._fault(message)
        except TooManyValues as error:
            found = "limits", str(error)
        except RecursionError:
            found = "types", "it is nested too deep"
        if found is not None:
            name, why = found
            first, count = self.faults.get(name, (f"a message on {message.topic} at {message.time:.3f} s: {why}", 0))
            self.faults[name] = first, count + 1

    def findings(self) -> Iterator[Finding]:
        yield self._finding("types", f"all {self.count} messages of the device are of their types")
        yield self._finding("finite", "all numbers are finite")
        yield self._finding("limits", "all values are within the limits of their schemas")
        if self.model is not None:
            missing = [one.topic for one in self.model.result if one.required and one.topic not in self.heard]
            if missing:
                self.faults.setdefault("model", (f"there is no message on {missing[0]}, which the model requires", 1))
            yield self._finding("model", "the messages are as the model describes results")

    def _finding(self, name: str, well: str) -> Finding:
        first, count = self.faults.get(name, ("", 0))
        more = f" (and {count - 1} more)" if count > 1 else ""
        return Finding(name, not count, first + more if count else well)

    def _fault(self, message: JudgedMessage) -> tuple[str, str] | None:
        """The kind of a message's first fault, and why; None if it has none."""
        value, kind = message.decoded(), message.type
        if isinstance(value, InvalidPayload):
            return "types", str(value)
        if isinstance(value, bytes) and kind.encoding != RAW.encoding:
            return "types", f"its type {kind.zenoh_encoding[:80]!r} can't be decoded"
        if not _is_finite(value, self.effort):
            return "finite", "a number is infinite or not a number"
        schema = _json_schema(kind)
        if schema is not None and (why := schema.fault(value, effort=self.effort)):
            return "limits", why
        described = (
            None if self.model is None else next((one for one in self.model.result if one.topic == message.topic), None)
        )
        if described is not None and (why := described.fault(kind, value, self.effort)):
            return "model", why
        return None


def _is_finite(value: Any, effort: Effort) -> bool:
    match value:
        case float():
            return math.isfinite(value)
        case list():
            effort.spend(len(value))
            return all(_is_finite(member, effort) for member in value)
        case dict():
            effort.spend(len(value))
            return all(_is_finite(member, effort) for member in value.values())
    return True


@lru_cache(maxsize=256)
def _json_schema(kind: PayloadType) -> ValueSchema | None:
    """The schema of JSON messages, as far as it is understood; None if it says nothing."""
    if kind.encoding != "json" or kind.schema_encoding != "jsonschema" or len(kind.schema_data) > _LONGEST_SCHEMA:
        return None
    try:
        return msgspec.convert(_understood(msgspec.json.decode(kind.schema_data)), ValueSchema)
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError):
        return None


def _understood(schema: Any, depth: int = MAX_DEPTH) -> dict[str, Any]:
    """The keywords of a JSON Schema that `ValueSchema` has; what is nested too deep fits any value."""
    kind = schema.get("type") if isinstance(schema, dict) else None
    if not isinstance(kind, str) or kind not in _OF_TYPE:
        return {}
    found = {name: schema[name] for name in _OF_TYPE[kind] if name in schema}
    if depth > 1 and kind == "array" and "items" in schema:
        found["items"] = _understood(schema["items"], depth - 1)
    if depth > 1 and kind == "object" and isinstance(schema.get("properties"), dict):
        found["properties"] = {name: _understood(one, depth - 1) for name, one in schema["properties"].items()}
        found["required"] = [name for name in schema.get("required", ()) if name in found["properties"]]
    return {"type": kind, **found}
