"""What an operator needs beside the roles: checks of a machine, identities of a site, backups of state."""
