"""The package as a whole: its public names, and what importing it loads."""

from __future__ import annotations

import subprocess
import sys

import pytest

import schemas

HEAVY = ("web3", "eth_account", "eth_abi", "eth_utils", "zenoh", "mcap", "asyncio", "mesh")


def loaded_by(imports: str, names: tuple[str, ...]) -> str:
    """Those of these modules that a fresh interpreter has loaded after the imports."""
    script = f"import sys; {imports}; print([name for name in {names} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()


def test_importing_the_package_loads_nothing_heavy() -> None:
    everything = "import schemas.rpc; [getattr(schemas, name) for name in schemas.__all__]"
    assert loaded_by(everything, HEAVY) == "[]"


def test_keys_and_payloads_load_no_signatures() -> None:
    keys = "from schemas import DeviceTopicKey, Empty, String; import schemas.keys, schemas.payloads"
    assert loaded_by(keys, ("coincurve", "schemas.signing", "schemas.messages")) == "[]"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Offre'"):
        _ = schemas.Offre  # type: ignore[attr-defined]
