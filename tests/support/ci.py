"""Whether CI runs the tests: it runs each with every implementation, and more random histories."""

from __future__ import annotations

import os
from typing import Final

IN_CI: Final = os.environ.get("CI") == "true"
