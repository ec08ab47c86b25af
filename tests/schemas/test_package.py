"""The package as a whole: what it offers, and how light it is."""

from __future__ import annotations

import subprocess
import sys

import schemas

HEAVY = ("web3", "eth_account", "eth_abi", "eth_utils", "zenoh", "mcap", "asyncio", "mesh")


def test_importing_it_loads_nothing_heavy() -> None:
    script = f"import sys, schemas, schemas.rpc; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_everything_it_names_is_there() -> None:
    assert len(set(schemas.__all__)) == len(schemas.__all__)
    assert all(hasattr(schemas, name) for name in schemas.__all__)
