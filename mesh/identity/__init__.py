"""Identities of a site: certificates, the roster, and the rights of members on the site's routers.

`certificates` and `folders` need the extra `identity`; import them where you use them.
"""

from mesh.identity.access_rules import access_control, access_of
from mesh.identity.errors import RosterError
from mesh.identity.roster import ROLES, Member, Right, Role, Roster, entry_of, read_roster, roster_from
