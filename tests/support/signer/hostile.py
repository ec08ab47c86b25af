"""What a malicious program tries at a signer, and how it is refused: one table for the tests and for the guide.

Each case is an order that a policy must refuse, by the policy of `signers.RULE`: it allows the topics /drive, /speed
and /stop of one model, within ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final


@dataclass(frozen=True, kw_only=True)
class Case:
    """An attempt: what is tried, and the code of the refusal. `order` changes a good order."""

    name: str
    tried: str
    code: str
    order: dict[str, Any] = field(default_factory=dict)


OTHER_MODEL: Final = "QmYwAPJzv5CZsnA625s3Xf2nemtYgPpHdWEz79ojWnPbdG"
STRANGER: Final = "0x000000000000000000000000000000000000bEEF"


def driving(**fields: Any) -> dict[str, Any]:
    """A message on /drive with other fields; None leaves one out."""
    value = {"radius": 1.0, "direction": "left"} | fields
    return {"messages": [("/drive", {name: one for name, one in value.items() if one is not None})]}


def beside(name: str) -> dict[str, Any]:
    """A good message on /drive with one more field."""
    return {"messages": [("/drive", {"radius": 1.0, "direction": "left", name: 9})]}


def on(topic: str, value: Any = None) -> dict[str, Any]:
    """One message on a topic."""
    return {"messages": [(topic, value)]}


VALUES: Final[tuple[tuple[str, dict[str, Any], str], ...]] = (
    ("a value above its range", driving(radius=2.01), "value-not-allowed"),
    ("a value below its range", driving(radius=0.19), "value-not-allowed"),
    ("a negative value", driving(radius=-1), "value-not-allowed"),
    ("a very large number", driving(radius=1e308), "value-not-allowed"),
    ("an integer of 20 digits", driving(radius=10**19), "value-not-allowed"),
    ("a number as a text", driving(radius="1.0"), "value-not-allowed"),
    ("true instead of a number", driving(radius=True), "value-not-allowed"),
    ("an array instead of a number", driving(radius=[1.0]), "value-not-allowed"),
    ("an object instead of a number", driving(radius={"value": 1.0}), "value-not-allowed"),
    ("a text that is not one of the choices", driving(direction="up"), "value-not-allowed"),
    ("a choice in other letters", driving(direction="LEFT"), "value-not-allowed"),
    ("a choice with a space behind it", driving(direction="left "), "value-not-allowed"),
    ("a choice with a Cyrillic letter", driving(direction="l\u0435ft"), "value-not-allowed"),
    ("a choice in full-width letters", driving(direction="\uff4c\uff45\uff46\uff54"), "value-not-allowed"),
    ("a choice with an invisible character", driving(direction="le\u200bft"), "value-not-allowed"),
    ("a choice that is shown backwards", driving(direction="\u202etfel"), "value-not-allowed"),
    ("a number instead of a choice", driving(direction=0), "value-not-allowed"),
    ("a required field left out", driving(radius=None), "value-not-allowed"),
    ("a value out of range deep in an array", driving(points=[{"x": 1}, {"x": 5.01}]), "value-not-allowed"),
    ("a text deep in an array", driving(points=[{"x": "1"}]), "value-not-allowed"),
    ("an object instead of an array", driving(points={"x": 1}), "value-not-allowed"),
    ("a number above its range on a topic without fields", on("/speed", 2.5), "value-not-allowed"),
    ("an object on a topic of numbers", on("/speed", {"data": 1}), "value-not-allowed"),
    ("a text on a topic without a value", on("/stop", "now"), "value-not-allowed"),
    ("a field on a topic without a value", on("/stop", {"force": 1}), "field-not-allowed"),
    (
        "one bad message behind many good ones",
        {"messages": [*driving()["messages"] * 50, ("/speed", 99)]},
        "value-not-allowed",
    ),
    ("a field that nobody allowed", driving(turbo=True), "field-not-allowed"),
    ("a field in capitals beside the allowed one", driving(Radius=9), "field-not-allowed"),
    ("a field with a Cyrillic letter", beside("r\u0430dius"), "field-not-allowed"),
    ("a field in full-width letters", beside("\uff52adius"), "field-not-allowed"),
    ("a field with an invisible character", beside("radius\u200b"), "field-not-allowed"),
    ("a field with a dot, as the path of another", beside("points.x"), "field-not-allowed"),
    ("a field without a name", beside(""), "field-not-allowed"),
    ("a field named like Python's", beside("__class__"), "field-not-allowed"),
    ("a field of an object deep in an array", driving(points=[{"x": 1, "z": 1}]), "field-not-allowed"),
    ("a topic that nobody allowed", on("/arm", {"angle": 1}), "topic-not-allowed"),
    ("a topic below an allowed one", on("/drive/raw", {"radius": 1}), "topic-not-allowed"),
    ("a topic in capitals", on("/Drive", {"radius": 1}), "topic-not-allowed"),
    ("the topic * of the policy's grammar", on("/*", 1), "topic-not-allowed"),
    ("a topic without a slash", on("drive", 1), "topic-not-allowed"),
    ("a topic with ..", on("/drive/../arm", 1), "topic-not-allowed"),
    ("a topic with a Cyrillic letter", on("/dr\u0456ve", {"radius": 1}), "topic-not-allowed"),
    ("a topic with an invisible character", on("/drive\u200b", {"radius": 1}), "topic-not-allowed"),
)
ORDERS: Final[tuple[tuple[str, dict[str, Any], str], ...]] = (
    ("another model", {"model": OTHER_MODEL}, "model-not-allowed"),
    ("no model", {"model": ""}, "invalid-cid"),
    ("a model that is a path", {"model": "../../etc/passwd"}, "invalid-cid"),
    ("a robot that is not allowed", {"robot": STRANGER}, "robot-not-allowed"),
    ("a robot by the name that a stranger chose", {"robot": "Rover"}, "invalid-address"),
    ("a robot's address with a wrong checksum", {"robot": STRANGER.replace("bEEF", "BeEf")}, "invalid-address"),
    ("more than a job may cost", {"cost": "5.000000001 XRT"}, "too-expensive"),
    ("more than there is in the world", {"cost": "1000000000000 XRT"}, "too-expensive"),
    ("a negative cost", {"cost": "-1 XRT"}, "invalid-amount"),
    ("a cost in another coin", {"cost": "1 ETH"}, "invalid-amount"),
    ("a cost in an exponent", {"cost": "1e9 XRT"}, "invalid-amount"),
    ("a cost in full-width digits", {"cost": "\uff11 XRT"}, "invalid-amount"),
    ("no messages", {"messages": []}, "invalid-request"),
    ("messages and an objective at once", {"objective": OTHER_MODEL}, "invalid-request"),
    ("an objective that is a path", {"messages": [], "objective": "/etc/passwd"}, "invalid-cid"),
)
CASES: Final = tuple(
    Case(name=f"{kind}-{number:02}", tried=tried, code=code, order=order)
    for kind, table in (("message", VALUES), ("order", ORDERS))
    for number, (tried, order, code) in enumerate(table, 1)
)
