"""Who belongs to a site: certificates, the roster, and what each may do on the site's routers.

`roles` and `access` say who may do what, from the roster alone; `zenoh_rules` puts it into Zenoh's words. What makes
certificates is in `certificates` and needs the extra `identity`; it is imported where it is used.
"""

from mesh.identity.access import Permission, access_of
from mesh.identity.errors import IdentityError, RosterError
from mesh.identity.roles import ROLES, Right, Role
from mesh.identity.roster import Member, Roster, entry_of, read_roster, roster_from
from mesh.identity.zenoh_rules import access_control

__all__ = [
    "ROLES",
    "IdentityError",
    "Member",
    "Permission",
    "Right",
    "Role",
    "Roster",
    "RosterError",
    "access_control",
    "access_of",
    "entry_of",
    "read_roster",
    "roster_from",
]
