"""The extras of aira-mesh: optional packages, and the error for one that is not installed."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator


class PackageMissing(ConfigurationError, ModuleNotFoundError, code="package-missing"):
    """An optional package is not installed. The hint names the extra that installs it."""

    def __init__(self, package: str, *, extra: str, user: str) -> None:
        super().__init__(
            f"{user} needs the package {package}, which is not installed", hint=f"pip install 'aira-mesh[{extra}]'"
        )
        self.package = package
        self.extra = extra


@contextmanager
def needs_extra(extra: str, user: str) -> Iterator[None]:
    """Raise `PackageMissing` if an import in the body fails. `user` is what needs the package, as in "the chain".

    Of nested ones the outermost names the extra.
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
