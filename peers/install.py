"""`python -m peers.install`: install the missing peers, go on when one fails, and list at the end what is installed.

Some are compiled while the others are downloaded. It may be run any number of times, and by several people at once. It
exits with 1 only where `AIRA_REQUIRE_PEERS=1` asks for all peers and one that a recipe should have given is missing.
"""

from __future__ import annotations

import fcntl
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

from peers.catalog import COMPILED, COMPILED_GO, DOWNLOADED, PEERS, PeerMissing
from peers.recipes import cache_folder
from peers.running import InstallFailed, Runner

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from peers.recipes import Recipe


def main(*queues: Sequence[Recipe]) -> int:
    """Install what is missing, print the table, and return the exit code.

    The recipes of one queue run one after the other, and the queues at the same time.
    """
    failures: dict[str, str] = {}
    with _alone(), ThreadPoolExecutor(max_workers=max(1, len(queues))) as threads:
        for failed in threads.map(_install_all, queues):
            failures |= failed
    missing = _print_table(failures)
    if os.environ.get("AIRA_REQUIRE_PEERS") == "1" and missing:
        print(f"\nAIRA_REQUIRE_PEERS=1, but missing: {', '.join(missing)}", file=sys.stderr)
        return 1
    return 0


def _install_all(recipes: Sequence[Recipe]) -> dict[str, str]:
    """Run `recipes` in turn; return the names of those that failed, with the reasons."""
    return {recipe.name: reason for recipe in recipes if (reason := _install(recipe))}


def _install(recipe: Recipe) -> str:
    """Run `recipe` if a peer that it gives is missing; return why it failed, or nothing."""
    if recipe.is_complete() and not _missing_from(recipe):
        return ""
    print(f"{recipe.name}: installing ...", flush=True)
    started = time.monotonic()
    log = cache_folder() / "logs" / f"{recipe.name.split()[0]}.log"
    log.unlink(missing_ok=True)
    try:
        recipe.install(Runner(log=log, environment=recipe.environment))
    except (InstallFailed, OSError) as error:
        print(f"{recipe.name}: failed: {error}", flush=True)
        return str(error)
    print(f"{recipe.name}: installed in {time.monotonic() - started:.0f} s", flush=True)
    return ""


def _missing_from(recipe: Recipe) -> list[str]:
    return [peer.name for peer in PEERS.values() if peer.recipe is recipe and peer.search() is None]


def _print_table(failures: dict[str, str]) -> list[str]:
    """Print a line for each peer and return the names of those that are missing and have a recipe."""
    missing = []
    print()
    for peer in PEERS.values():
        try:
            state = str(peer.locate())
        except PeerMissing as error:
            reason = failures.get(peer.recipe.name, error.reason) if peer.recipe else error.reason
            state = f"MISSING  {reason}" if peer.recipe else f"absent   {reason}"
            if peer.recipe:
                missing.append(peer.name)
        print(f"{peer.name:15} {peer.purpose:66} {state}")
    return missing


@contextmanager
def _alone() -> Iterator[None]:
    """One installer at a time in a cache folder; a second one waits for the first."""
    cache_folder().mkdir(parents=True, exist_ok=True)
    with (cache_folder() / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


if __name__ == "__main__":
    sys.exit(main(COMPILED, COMPILED_GO, DOWNLOADED))
