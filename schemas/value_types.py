"""From Python types to the schemas of values, and whether the values of one schema fit another."""

from __future__ import annotations

from inspect import cleandoc
from math import inf
from typing import Any, Final

import msgspec

from schemas.model import InvalidDescription, ModelTopic
from schemas.payloads import EMPTY, RAW, STRING, Empty, String
from schemas.value_schema import ValueSchema

_KEPT: Final = (
    *("type", "title", "unit", "minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "minLength", "maxLength"),
    *("contentEncoding", "minItems", "maxItems"),
)
"""The keywords that msgspec and a schema of values share; others only describe, or go beyond what is checked."""


def topic_of(topic: str, kind: Any, **fields: Any) -> ModelTopic:
    """The description of a topic whose messages have a Python type: a Struct, `float`, `String`, …

    `fields` are the others of `ModelTopic`. Limits, title and unit of a value are those of `msgspec.Meta` (the unit in
    `extra_json_schema={"unit": "m/s"}`). A type that no schema can describe is described as any value. Raises
    `InvalidDescription` if a name or a limit is out of range.
    """
    if kind is bytes:
        return ModelTopic(topic=topic, encoding=RAW.zenoh_encoding, **fields)
    if kind is Empty:
        return ModelTopic(topic=topic, encoding=EMPTY.zenoh_encoding, value=ValueSchema(type="null"), **fields)
    if kind is String:
        return ModelTopic(topic=topic, encoding=STRING.zenoh_encoding, value=ValueSchema(type="string"), **fields)
    value = schema_of(kind)
    return ModelTopic(topic=topic, value=value if value != ValueSchema() else None, **fields)


def schema_of(kind: Any) -> ValueSchema:
    """The schema of the values of a Python type in JSON; see `topic_of`."""
    try:
        (root,), definitions = msgspec.json.schema_components((kind,), ref_template="{name}")
    except (TypeError, RecursionError):
        return ValueSchema()
    try:
        return msgspec.convert(_narrowed(root, definitions), ValueSchema)
    except msgspec.ValidationError as error:
        raise InvalidDescription("field", f"{getattr(kind, '__name__', kind)}: {error}") from None


def topic_gap(described: ModelTopic, taken: ModelTopic) -> str:
    """Why a message that fits a described topic may not fit what a handler takes, in one line; empty if each does."""
    name, raw = described.topic, RAW.zenoh_encoding
    if taken.encoding == raw and (described.value is not None or not described.encoding):
        return f"{name} must have an encoding and no value: the handler takes bytes"
    if taken.encoding not in ("", raw, described.encoding):
        return f"{name} must have the encoding {taken.encoding}, which is what the handler takes"
    return _gap(described.value or ValueSchema(), taken.value or ValueSchema(), name)


def _gap(described: ValueSchema, taken: ValueSchema, name: str) -> str:
    if not taken.type:
        return ""
    if described.type != taken.type and (described.type, taken.type) != ("integer", "number"):
        return f"{name} is {described.type or 'any value'} for the model, and {taken.type} for the handler"
    if described.enum:
        return next(filter(None, (taken.fault(choice, name) for choice in described.enum)), "")
    (low, high), (least, most) = _bounds(described), _bounds(taken)
    if taken.enum or low < least or high > most:
        return f"{name} may have values for the model that the handler does not take"
    if missing := [field for field in taken.required if field not in described.required]:
        return f"{name} may lack {missing[0]}, which the handler needs"
    if taken.items is not None and (why := _gap(described.items or ValueSchema(), taken.items, f"{name}[]")):
        return why
    shared = [field for field in taken.properties if field in described.properties]
    inner = (_gap(described.properties[field], taken.properties[field], f"{name}.{field}") for field in shared)
    return next(filter(None, inner), "")


def _bounds(schema: ValueSchema) -> tuple[tuple[float, int], tuple[float, int]]:
    """The least and the greatest number, length or count, each with a number that orders exclusive bounds."""
    lows = ((schema.minimum, 0), (schema.exclusive_minimum, 1), (schema.min_length, 0), (schema.min_items, 0))
    highs = ((schema.maximum, 1), (schema.exclusive_maximum, 0), (schema.max_length, 1), (schema.max_items, 1))
    low = max(((limit, order) for limit, order in lows if limit is not None), default=(-inf, 0))
    high = min(((limit, order) for limit, order in highs if limit is not None), default=(inf, 1))
    return low, high


def _narrowed(schema: Any, definitions: dict[str, Any], above: tuple[str, ...] = ()) -> dict[str, Any]:
    """What a schema of msgspec says, in the keywords of `ValueSchema`; a type within itself is any value."""
    if not isinstance(schema, dict):
        return {}
    if reference := schema.get("$ref"):
        if reference in above:
            return {}
        own = {key: value for key, value in schema.items() if key != "$ref"}
        definition = {key: value for key, value in definitions[reference].items() if key != "title"}  # a class's name
        return _narrowed({**definition, **own}, definitions, (*above, reference))
    if alternatives := schema.get("anyOf"):
        others = [one for one in alternatives if one != {"type": "null"}]
        rest = {key: value for key, value in schema.items() if key != "anyOf"}
        return _narrowed({**others[0], **rest}, definitions, above) if len(others) == 1 else {}
    narrowed = {key: schema[key] for key in _KEPT if key in schema}
    if text := " ".join(cleandoc(schema.get("description", "")).split()):
        narrowed["description"] = text
    if isinstance(schema.get("default"), str | int | float) and "enum" not in schema:
        narrowed["default"] = schema["default"]
    if choices := schema.get("enum"):
        kind = {str: "string", int: "integer"}.get(type(choices[0]) if len(set(map(type, choices))) == 1 else object)
        narrowed |= {"type": kind, "enum": choices} if kind else {}
        if kind and schema.get("default") in choices:
            narrowed["default"] = schema["default"]
    if schema.get("type") == "array":
        narrowed |= {"items": items} if (items := _narrowed(schema.get("items"), definitions, above)) else {}
    if schema.get("type") == "object":
        inner = {key: _narrowed(one, definitions, above) for key, one in schema.get("properties", {}).items()}
        narrowed |= {"properties": inner} if inner else {}
        narrowed |= {"required": required} if (required := schema.get("required")) else {}
    return narrowed
