"""For tests of robots and of those who order from them: `FakeJob` for handlers alone, `Market` for everything.

With pytest the fixture `market` is there without an import. Use it in tests only: nothing here guards real money.
"""

from __future__ import annotations

from typing import Any

from mesh.base.extras import needs_extra
from schemas.loading import on_demand

_load, __all__ = on_demand(__name__)


def __getattr__(name: str) -> Any:
    with needs_extra("testing", "mesh.testing"):
        return _load(name)
