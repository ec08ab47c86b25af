"""Lowering the interpreter's recursion limit again.

py_ecc, which the Ethereum libraries import, raises it to 100,000. Deeply nested JSON then overflows the C stack before
it is refused, so a single message could end the process. At 12,288, which py-evm sets, it still does in threads with a
stack of 2 MB, such as Zenoh's.
"""

from __future__ import annotations

import sys
from typing import Final

RECURSION_LIMIT: Final = 3_000
"""Frames: safe on a stack of 2 MB (measured; 6,000 is not), and enough for contracts that call 200 deep."""


def restrain_recursion() -> None:
    """Lower the recursion limit to `RECURSION_LIMIT` where it is higher. Called after the imports that raise it."""
    sys.setrecursionlimit(min(sys.getrecursionlimit(), RECURSION_LIMIT))
