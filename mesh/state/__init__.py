"""The state of agents as a whole: looked at, backed up while they run, restored."""

from mesh.state.archive import About
from mesh.state.backup import BackedUp, Extent, back_up
from mesh.state.errors import ArchiveUnusable, NoState, StateExists, StateInUse, StateRestless
from mesh.state.inventory import AccountState, ArchiveContents, ChainState, Inventory, examine_archive, take_inventory
from mesh.state.restoring import Existing, Restored, restore

__all__ = [
    "About",
    "AccountState",
    "ArchiveContents",
    "ArchiveUnusable",
    "BackedUp",
    "ChainState",
    "Existing",
    "Extent",
    "Inventory",
    "NoState",
    "Restored",
    "StateExists",
    "StateInUse",
    "StateRestless",
    "back_up",
    "examine_archive",
    "restore",
    "take_inventory",
]
