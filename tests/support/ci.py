"""Whether CI runs the tests: it runs all of them, each with every implementation, and more random cases."""

from __future__ import annotations

import os
from typing import Final

IN_CI: Final = os.environ.get("CI") == "true"
EXAMPLES: Final = 100 if IN_CI else 25
"""Of a property test."""
