"""A chain with contracts and accounts, one of which the doctor checks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.ops.doctor import DoctorContext
from mesh.settings import Settings
from tests.support.cli.served_chain import PASSWORD, ServedChain
from tests.support.doctor.examining import Found, examined

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.doctor.checks import Role


class Machine:
    """Where the town's people are examined: with a router, and folders of their own."""

    def __init__(self, town: ServedChain, endpoint: str, folder: Path) -> None:
        self.town = town
        self.endpoint = endpoint
        self.folder = folder

    def settings(self, who: str = "", **options: Any) -> Settings:
        named: dict[str, Any] = {
            "connect": (self.endpoint,),
            "web3_http_provider": self.town.url,
            "data_dir": str(self.folder),
        }
        if who:
            (self.folder / "password").write_text(PASSWORD + "\n")
            (self.folder / "password").chmod(0o600)
            named |= {
                "keyfile": str(self.town.people[who].keyfile),
                "keyfile_password_file": str(self.folder / "password"),
            }
        return Settings(**(named | options))

    async def examined(self, role: Role | None, who: str = "", *, chain_id: int = 0, **options: Any) -> Found:
        return await examined(
            DoctorContext(settings=self.settings(who, **options), requested_role=role, chain_id=chain_id)
        )
