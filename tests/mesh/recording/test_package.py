from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
HEAVY = ("web3", "eth_account", "eth_abi", "rosbags", "numpy")


def test_content_and_recording_load_no_heavy_packages() -> None:
    program = f"import sys, mesh.content, mesh.recording; print([name for name in {HEAVY} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"
