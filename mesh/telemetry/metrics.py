"""Metric families in Prometheus terms. Pure: a role builds these from its counters and knows nothing of HTTP.

Names end in their unit (`_seconds`, `_bytes`, `_wei`, `_wn`), and counters in `_total`. Amounts of money are floats
here, because Prometheus has no other numbers: precise enough for a graph, not for accounting.

The health of a role is the state of each of its parts, for `/health` and `aira health`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec

from mesh.errors import ConfigurationError, public_text
from schemas.decoding import decode_json
from schemas.status import ALIVE, OFF

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mesh.base.flood import Drops

MetricType = Literal["counter", "gauge"]
"""A counter only grows while a process runs; a gauge goes up and down."""


class MetricSample(NamedTuple):
    """One value of a family, identified by its labels."""

    value: float
    labels: Mapping[str, str] = {}


class MetricFamily(NamedTuple):
    """All samples with one name, such as `aira_messages_total` by kind and verdict."""

    name: str
    kind: MetricType
    meaning: str
    """One line of help, shown by `/metrics`."""
    samples: tuple[MetricSample, ...]


def counter(name: str, meaning: str, value: float) -> MetricFamily:
    """A counter without labels."""
    return MetricFamily(name, "counter", meaning, (MetricSample(value),))


def gauge(name: str, meaning: str, value: float) -> MetricFamily:
    """A gauge without labels."""
    return MetricFamily(name, "gauge", meaning, (MetricSample(value),))


def by_label(name: str, kind: MetricType, meaning: str, label: str, values: Mapping[str, float]) -> MetricFamily:
    """A family with one label and a sample for each of its values."""
    return MetricFamily(name, kind, meaning, tuple(MetricSample(value, {label: key}) for key, value in values.items()))


def drop_family(drops: Drops) -> MetricFamily:
    """What a role dropped because of floods."""
    meaning = "Messages, requests and the like that were dropped because there were too many, by reason"
    return by_label("aira_dropped_total", "counter", meaning, "reason", drops.totals())


def labelled(families: Iterable[MetricFamily], **labels: str) -> tuple[MetricFamily, ...]:
    """The same families with more labels on every sample, such as the lighthouse. A sample's own labels win."""
    return tuple(
        family._replace(
            samples=tuple(MetricSample(sample.value, {**labels, **sample.labels}) for sample in family.samples)
        )
        for family in families
    )


def merged(families: Iterable[MetricFamily]) -> tuple[MetricFamily, ...]:
    """One family for each name, with the samples of all families of that name.

    Several roles of one process report the same families. Raises `ValueError` if two families share a name but differ
    in type or meaning.
    """
    found: dict[str, MetricFamily] = {}
    for family in families:
        known = found.setdefault(family.name, family._replace(samples=()))
        if (known.kind, known.meaning) != (family.kind, family.meaning):
            raise ValueError(f"two families named {family.name}")
        found[family.name] = known._replace(samples=known.samples + family.samples)
    return tuple(found.values())


STARTING: Final = "still waits"
"""The state of a role's part `start` until the role has started."""


class Health(msgspec.Struct, frozen=True):
    """The state of each part of a role. `ok` if every part is `ALIVE`, or `OFF` by its settings."""

    ok: bool
    parts: dict[str, str]

    @classmethod
    def of(cls, parts: Mapping[str, str]) -> Health:
        """The health of a role with these parts (name → state).

        Anyone who reaches the page can read it.
        """
        return cls(all(is_healthy(state) for state in parts.values()), public_parts(parts))

    def encode(self) -> bytes:
        """The JSON object that `/health` answers."""
        return msgspec.json.encode(self)

    @classmethod
    def decode(cls, answer: bytes) -> Health:
        """Read an answer of `/health`. Raises `InvalidData`."""
        return decode_json(answer, cls)


def public_parts(parts: Mapping[str, str]) -> dict[str, str]:
    """The states of parts as strangers may read them."""
    return {part: public_text(state) for part, state in parts.items()}


def is_healthy(state: str) -> bool:
    """Whether a part in this state needs no attention."""
    return state in (ALIVE, OFF)


def health_metrics(parts: Mapping[str, str]) -> MetricFamily:
    """Health as a metric, so that alerts can use it: 1 for each part that works, 0 for each that does not."""
    values = {part: float(is_healthy(state)) for part, state in parts.items()}
    return by_label(
        "aira_part_up", "gauge", "1 for a part of this role that does what it is for, 0 otherwise", "part", values
    )


def listen_address(listen: str) -> tuple[str, int]:
    """Parse HOST:PORT; an IPv6 address is in brackets. Raises `ConfigurationError`."""
    host, _, port = listen.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    if not bare or (":" in bare) == (bare == host) or not (port.isascii() and port.isdigit()) or int(port) > 65_535:
        raise ConfigurationError(
            f"metrics_listen is {listen!r}, not HOST:PORT",
            hint="give --metrics-listen 127.0.0.1:9464, or 0.0.0.0:9464 for other machines; empty serves no metrics",
            code="invalid-listen-address",
        )
    return bare, int(port)
