"""What a bridge has done since it last said so, as one line of its log. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from schemas.status import BridgeStatus

STANDING: Final = ("waiting", "left_waiting", "unheard")
"""Figures that tell how it is now, not how often something happened."""


def figures_of(status: BridgeStatus) -> dict[str, int]:
    """All that is counted in a status, by names such as `to_ipfs.invalid.signature`."""
    figures = {"losses": status.losses}
    for name in ("to_ipfs", "to_mesh", "content"):
        part = getattr(status, name)
        if part is not None:
            figures.update(_flat(name, msgspec.structs.asdict(part)))
    return figures


def news(before: Mapping[str, int], now: Mapping[str, int]) -> str:
    """What is different, as `name=+12` for what was counted and `name=12` for what waits; empty if nothing is."""
    return " ".join(
        f"{name}={value}" if name.rpartition(".")[2] in STANDING else f"{name}={value - before.get(name, 0):+d}"
        for name, value in now.items()
        if value != before.get(name, 0)
    )


def _flat(name: str, values: Mapping[str, Any]) -> Iterator[tuple[str, int]]:
    for key, value in values.items():
        match value:
            case int():
                yield f"{name}.{key}", value
            case dict():
                yield from _flat(f"{name}.{key}", value)
