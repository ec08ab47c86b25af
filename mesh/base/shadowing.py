"""Other folders of the names of our packages: a program's own `schemas/`, or one in the folder that a user works in."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

PACKAGES = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
"""The folder of our packages."""


def require_own(package: str) -> None:
    """Raise `ImportError` if a package of ours is hidden by another one, which Python finds first.

    `python -m mesh` never needs what is in the current folder, so that is no longer searched for packages.
    """
    folder = os.path.abspath(sys.path[0]) if sys.path else PACKAGES
    if _is_run_as_module() and not sys.flags.safe_path and folder != PACKAGES:
        del sys.path[0]
    found = sys.modules[package].__spec__ if package in sys.modules else find_spec(package)
    origin = (found and found.origin) or str(found and found.submodule_search_locations)
    if os.path.dirname(os.path.dirname(origin)) != PACKAGES:
        raise ImportError(
            f"aira-mesh needs its own package {package!r}, but Python finds {origin}: rename that, or move your program"
            " to another folder",
            name=package,
        )


def _is_run_as_module() -> bool:
    """Whether Python is about to run `python -m mesh`: until it has found that, the program's name is `-m`."""
    return sys.argv[:1] == ["-m"] and "-m mesh " in f"{' '.join(sys.orig_argv)} "
