"""The state of the agents of a data folder: list it, back it up while they run, restore it."""

from mesh.ops.state._backup import ContentScope, back_up, restore
from mesh.ops.state._inventory import ArchiveContents, Inventory, examine_archive, take_inventory
