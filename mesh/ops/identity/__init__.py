"""Identities of a site: certificates, the roster, and the rights of members on the site's routers.

`certificates` and `folders` need the extra `identity`; import them where you use them.
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
