"""`python -m tests.simulation`: run histories."""

from __future__ import annotations

import logging  # noqa: F401 - before the locks are replaced: it keeps real ones
import os
import sys

if os.environ.get("PYTHONHASHSEED") != "0":
    os.environ["PYTHONHASHSEED"] = "0"
    os.execv(sys.executable, [sys.executable, "-m", "tests.simulation", *sys.argv[1:]])

from tests.simulation import threads

threads.install()

from tests.simulation.command import main  # noqa: E402 - after the clock and the threads were replaced

main(sys.argv[1:])
