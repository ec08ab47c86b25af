"""The interpreter's recursion limit, put right again.

py_ecc, which every Ethereum library here imports in the end, sets it to 100,000 when it is loaded. Deeply nested JSON
then overflows the stack of C before it is refused, and so a single message could end the process; at 12,288, which
py-evm wants, it still does in threads with a stack of 2 MB, as Zenoh's are.
"""

from __future__ import annotations

import sys
from typing import Final

RECURSION_LIMIT: Final = 3_000
"""Frames: safe on a stack of 2 MB (measured; 6,000 is not), and enough for contracts that call 200 deep."""


def restrain_recursion() -> None:
    """Lower the recursion limit to `RECURSION_LIMIT` where it is higher. Called after the imports that raise it."""
    sys.setrecursionlimit(min(sys.getrecursionlimit(), RECURSION_LIMIT))
