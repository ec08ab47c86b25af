"""Expecting errors by their class and fields, such as their code."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

E = TypeVar("E", bound=BaseException)


@contextmanager
def raises_with(kind: type[E], *, match: str | None = None, **fields: object) -> Iterator[pytest.ExceptionInfo[E]]:
    """Expect an error of a class whose fields have these values, and whose text matches."""
    with pytest.raises(kind, match=match) as caught:
        yield caught
    assert {name: getattr(caught.value, name) for name in fields} == fields
