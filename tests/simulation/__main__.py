"""`python -m tests.simulation`: run histories."""

from __future__ import annotations

import logging  # before the locks are replaced: it keeps real ones
import os
import sys
import traceback

if os.environ.get("PYTHONHASHSEED") != "0":
    os.environ["PYTHONHASHSEED"] = "0"
    os.execv(sys.executable, [sys.executable, "-m", "tests.simulation", *sys.argv[1:]])

from tests.simulation import threads

threads.install()
logging.getLogger().setLevel(logging.CRITICAL)

try:
    from tests.simulation.command import main

    main(sys.argv[1:])
except SystemExit as end:
    code = end.code if isinstance(end.code, int) else 1
except BaseException:
    traceback.print_exc()
    code = 1
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)  # Python's own end would wait for simulated threads
