"""The state of the agents of a data folder: list it, back it up while they run, restore it."""

from mesh.state.backup import ContentScope, back_up
from mesh.state.inventory import ArchiveContents, Inventory, examine_archive, take_inventory
from mesh.state.layout import ArchiveUnusable, NoState, StateChanging, StateExists, StateInUse
from mesh.state.restoring import ExistingState, restore
