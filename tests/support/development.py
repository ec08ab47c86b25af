"""The accounts of a development market, `aira up` or `aira chain up`, whose keys are in its folder."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.settings import Settings

if TYPE_CHECKING:
    from pathlib import Path


def variables_of(role: str, folder: Path, *, url: str, **settings: str) -> dict[str, str]:
    """The environment of a command that one of them runs at that node, with other settings by their names."""
    keys = folder / "development"
    named = {
        "web3_http_provider": url,
        "data_dir": str(folder),
        "keyfile": str(keys / f"{role}.json"),
        "keyfile_password_file": str(keys / "password"),
        "poll_interval": "0.1",
    }
    return {f"AIRA_{name.upper()}": value for name, value in (named | settings).items()}


def settings_of(role: str, folder: Path, *, url: str, endpoint: str, **options: Any) -> Settings:
    """The settings of one of them in this process, at that node and router; jobs are played at once."""
    keys = folder / "development"
    return Settings(
        connect=(endpoint,),
        web3_http_provider=url,
        data_dir=str(folder / role),
        poll_interval=0.05,
        playback="at-once",
        keyfile=str(keys / f"{role}.json"),
        keyfile_password_file=str(keys / "password"),
        **options,
    )
