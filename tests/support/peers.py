"""The real programs that tests use: a test without its program is skipped, or fails if all are required."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from peers.catalog import PEERS, PeerMissing, locate

if TYPE_CHECKING:
    from pathlib import Path


def require(name: str) -> Path:
    """Where the peer `name` is.

    Where it is missing the test is skipped with the reason. Under `AIRA_REQUIRE_PEERS=1` it fails instead, unless the
    peer is one that no recipe can give.
    """
    try:
        return locate(name)
    except PeerMissing as missing:
        if os.environ.get("AIRA_REQUIRE_PEERS") == "1" and PEERS[name].recipe is not None:
            pytest.fail(str(missing), pytrace=False)
        pytest.skip(str(missing))
