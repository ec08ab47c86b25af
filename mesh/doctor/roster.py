"""A router's roster, as the router reads it when it starts. Blocks while it is read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mesh.doctor.findings import Finding, broken, sound
from mesh.identity.roster import read_roster
from mesh.identity.routers import router_endpoints

if TYPE_CHECKING:
    from mesh.doctor.case import Case


def look_at_roster(case: Case) -> Finding:
    """Whether the router's settings can work, and who is let in. Raises `ConfigurationError`."""
    router_endpoints(case.settings)
    if not case.settings.roster:
        return sound("none: the router listens on this machine only, and lets everybody write everything")
    roster = read_roster(Path(case.settings.roster).expanduser())
    admitted = roster.admitted()
    if not admitted:
        return broken(
            f"{case.settings.roster} names nobody who is let in",
            do="`aira identity new FOLDER --site SITE --role ROLE --roster FILE` makes a member",
        )
    own = case.identity.address if case.identity is not None else ""
    if own and case.settings.link and own not in {who.address for who in admitted}:
        return broken(
            f"{own} is not in {case.settings.roster}: the routers that this one links to heed it not",
            do="add it there with the role router, and to the rosters of the others",
        )
    revoked = len(roster.member) - len(admitted)
    members = f"{len(admitted)} member{'' if len(admitted) == 1 else 's'}, {revoked or 'none'} revoked"
    return sound(f"{members}, markets {', '.join(roster.lighthouses)}")
