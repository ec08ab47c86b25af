"""The state of the agents of a data folder: list it, back it up while they run, restore it."""

from mesh.state.archive import ArchiveInfo
from mesh.state.backup import BackupReport, ContentScope, back_up
from mesh.state.inventory import AccountState, ArchiveContents, ChainState, Inventory, examine_archive, take_inventory
from mesh.state.layout import ArchiveUnusable, NoState, StateChanging, StateExists, StateInUse
from mesh.state.restoring import ExistingState, RestoreReport, restore

__all__ = [
    "AccountState",
    "ArchiveContents",
    "ArchiveInfo",
    "ArchiveUnusable",
    "BackupReport",
    "ChainState",
    "ContentScope",
    "ExistingState",
    "Inventory",
    "NoState",
    "RestoreReport",
    "StateChanging",
    "StateExists",
    "StateInUse",
    "back_up",
    "examine_archive",
    "restore",
    "take_inventory",
]
