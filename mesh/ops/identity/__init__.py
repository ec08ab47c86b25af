"""Identities of a site: certificates, the roster, and the rights of members on the site's routers.

`certificates` needs the extra `identity`; import it where you use it.
"""

from mesh.ops.identity.roster import (
    ROLES,
    Member,
    Right,
    Role,
    Roster,
    access_control,
    access_of,
    entry_of,
    read_roster,
    roster_from,
)
