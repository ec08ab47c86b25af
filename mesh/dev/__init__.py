"""For development: a chain with the contracts (an EVM in this process, or anvil), and a whole market in one process.

This is a server; the client is `mesh.chain`.
"""

from __future__ import annotations

import os
from typing import Any

from mesh.base.extras import needs_extra
from schemas.loading import on_demand

# Before py-evm is imported, which hashes at import. It would spend a sixth of its time in the objects of the default.
os.environ.setdefault("ETH_HASH_BACKEND", "pysha3")

_load, __all__ = on_demand(__name__)


def __getattr__(name: str) -> Any:
    with needs_extra("demo", "the development chain"):
        return _load(name)
