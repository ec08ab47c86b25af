"""Sites for tests: members with certificates, a roster, and a router that knows no others."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import zenoh

from mesh.network import Endpoints, Tls
from mesh.ops.identity import Member, entry_of
from mesh.ops.identity.certificates import Holder, MemberFolder, SiteFolder
from mesh.ops.identity.routers import router_endpoints, zenohd_configuration
from mesh.settings import Settings
from tests.support.peers import require
from tests.support.ports import answers, free_port
from tests.support.processes import Server

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

MARKET = "airalab.lighthouse.3.robonomics.eth"


class Site:
    """A site in a folder: its certificate, a router's, and those of the members that are added."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kind = "wheel"
        self.authority = SiteFolder(folder / "site")
        self.authority.make(name="test site", days=2)
        self.roster = folder / "roster.toml"
        self.roster.write_text(f'lighthouses = ["{MARKET}"]\n\n')
        self.port = free_port()
        self.endpoint = f"tls/127.0.0.1:{self.port}"
        self.router = self.certify("router", "0x" + "99" * 20, "router", hosts=("127.0.0.1",))

    def certify(
        self, name: str, address: str, *roles: str, days: float = 1, hosts: tuple[str, ...] = ()
    ) -> MemberFolder:
        """Make a certificate that is not in the roster."""
        folder = MemberFolder(self.folder / name)
        folder.make(Holder(address=address, name=name, roles=roles, hosts=hosts), site=self.authority, days=days)
        return folder

    def enlist(self, member: Member) -> MemberFolder:
        """Make a certificate, and write its holder into the roster."""
        revoked = "revoked = true\n" if member.revoked else ""
        self.roster.write_text(self.roster.read_text() + entry_of(member) + revoked + "\n")
        hosts = ("127.0.0.1",) if "router" in member.roles else ()
        return self.certify(member.name, member.address, *member.roles, hosts=hosts)

    def settings(self) -> Settings:
        """The settings of the site's router."""
        return Settings(
            listen=(self.endpoint,),
            roster=str(self.roster),
            tls_ca=str(self.router.ca),
            tls_certificate=str(self.router.certificate),
            tls_key=str(self.router.key),
        )

    def client(self, folder: MemberFolder, *, timeout: float = 10.0) -> Endpoints:
        """A client's way to the site's router, as the holder of a certificate."""
        tls = Tls(ca=folder.ca, certificate=folder.certificate, key=folder.key)
        return Endpoints(connect=(self.endpoint,), timeout=timeout, tls=tls)

    @contextmanager
    def open_router(self, kind: str) -> Iterator[None]:
        """Run the site's router: `wheel`, in this process, or `zenohd`."""
        endpoints = router_endpoints(self.settings())
        if kind == "wheel":
            session = zenoh.open(endpoints.config())
            try:
                yield
            finally:
                session.close()  # type: ignore[no-untyped-call]
        else:
            with SiteZenohd(self.port, zenohd_configuration(endpoints)):
                yield


class SiteZenohd(Server):
    """`zenohd` with a configuration file as `aira router config` writes it."""

    name = "zenohd"

    def __init__(self, port: int, configuration: str) -> None:
        self._program: Path = require("zenohd")
        super().__init__()
        self._port = port
        self._configuration = configuration

    def command(self) -> Sequence[str | Path]:
        """The program with its file."""
        file = self.folder / "zenohd.json5"
        file.write_text(self._configuration)
        return [self._program, "--config", file]

    def is_ready(self) -> bool:
        """Whether it takes connections."""
        return answers(self._port)
