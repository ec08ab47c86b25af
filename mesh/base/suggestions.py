"""What a user may have meant by a name that does not exist."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that looks most like `name`; None if none is similar, as a wrong suggestion is worse than none."""
    import difflib  # here, as an edge agent must stay small and rarely needs it

    return next(iter(difflib.get_close_matches(name, known, n=1)), None)
