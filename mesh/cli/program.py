"""Python programs of users, from which commands take an agent or a validator without starting it."""

from __future__ import annotations

import runpy
import sys
from contextlib import contextmanager
from traceback import extract_tb
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from mesh.errors import AiraError, InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

K = TypeVar("K")


def run_program(path: Path, kind: type[Any]) -> dict[str, Any]:
    """The names that a Python program has, which is run without starting its agent (`kind`).

    Raises `InputError`, and any `AiraError` of the program.
    """
    with _importing_from(path.parent), _not_running(kind, path) as started:
        try:
            return runpy.run_path(str(path), run_name=path.stem)
        except AiraError:
            raise
        except (Exception, SystemExit) as error:  # whatever the program raises
            if started:  # `run_to_end` has reported it
                raise
            lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
            where = f"{path}:{lines[-1]}" if lines else str(path)
            why = " ".join(str(error).split())
            raise InputError(f"can't run {where}: {type(error).__name__}: {why}", code="program-unusable") from error


def only(names: dict[str, Any], kind: type[K], path: Path, *, hint: str) -> K | None:
    """The one object of that kind that a program has, None if there is none. Raises `InputError` for several."""
    found = {name: value for name, value in names.items() if isinstance(value, kind)}
    if len(set(map(id, found.values()))) > 1:
        raise InputError(
            f"{path} has several objects {kind.__name__}: {', '.join(sorted(found))}",
            hint=hint,
            code="program-unusable",
        )
    return next(iter(found.values()), None)


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Import modules from there, as a program does that Python runs."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


@contextmanager
def _not_running(kind: type[Any], path: Path) -> Iterator[list[Any]]:
    """Let `agent.run()`, with which many programs end, do nothing, and let `async with agent` fail.

    Yields the list of the agents that the program would have started.
    """
    run, enter = kind.run, kind.__aenter__
    started: list[Any] = []

    async def refuse(agent: Any) -> NoReturn:
        started.append(agent)
        raise InputError(
            f"{path} starts its {kind.__name__.lower()}",
            hint='do that below `if __name__ == "__main__":`',
            code="program-unusable",
        )

    kind.run, kind.__aenter__ = lambda agent: None, refuse
    try:
        yield started
    finally:
        kind.run, kind.__aenter__ = run, enter
