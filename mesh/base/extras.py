"""The extras of aira-mesh: importing optional packages, and the error for one that is not installed."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator

RECURSION_LIMIT: Final = 3_000
"""Frames: safe on a stack of 2 MB (measured; 6,000 is not), and enough for contracts that call 200 deep."""


def install(extra: str) -> str:
    """How to install an extra: aira-mesh is in no registry of packages, so from its sources."""
    return f"in a clone of aira-mesh: pip install '.[{extra}]'"


class PackageMissing(ConfigurationError, ModuleNotFoundError, code="package-missing"):
    """An optional package is not installed. The hint names the extra that installs it."""

    def __init__(self, package: str, *, extra: str, user: str) -> None:
        super().__init__(f"{user} needs the package {package}, which is not installed", hint=install(extra))
        self.package = package
        self.extra = extra


@contextmanager
def needs_extra(extra: str, user: str) -> Iterator[None]:
    """Raise `PackageMissing` if an import in the body fails. `user` is what needs the package, as in "the chain".

    Of nested ones the outermost names the extra. Afterwards the interpreter's recursion limit is `RECURSION_LIMIT` at
    most: py_ecc raises it to 100,000, py-evm to 12,288, and then deeply nested JSON overflows the stack of a thread
    before it is refused, so that a single message could end the process.
    """
    try:
        yield
    except PackageMissing as error:
        raise PackageMissing(error.package, extra=extra, user=user) from None
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "mesh", "bridges", "schemas"):
            raise
        raise PackageMissing(package, extra=extra, user=user) from error
    finally:
        sys.setrecursionlimit(min(sys.getrecursionlimit(), RECURSION_LIMIT))
