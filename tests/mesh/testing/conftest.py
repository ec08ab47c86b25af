"""The fixtures of the pytest plugin, also where this tree was installed before it had one."""

from mesh.testing._plugin import market, market_chain

__all__ = ["market", "market_chain"]
