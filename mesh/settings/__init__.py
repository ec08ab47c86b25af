"""Settings: the options in groups, and how they are loaded."""

from mesh.settings.groups import (
    DEFAULTS,
    LONGEST,
    MEANING,
    OPTIONS,
    AccountSettings,
    ChainSettings,
    ContentSettings,
    ExecutionSettings,
    IpfsSettings,
    MarketSettings,
    NetworkSettings,
    RouterSettings,
    Settings,
    StorageSettings,
    TelemetrySettings,
    options_of,
)
from mesh.settings.loading import NOT_OPTIONS, load

__all__ = [
    "DEFAULTS",
    "LONGEST",
    "MEANING",
    "NOT_OPTIONS",
    "OPTIONS",
    "AccountSettings",
    "ChainSettings",
    "ContentSettings",
    "ExecutionSettings",
    "IpfsSettings",
    "MarketSettings",
    "NetworkSettings",
    "RouterSettings",
    "Settings",
    "StorageSettings",
    "TelemetrySettings",
    "load",
    "options_of",
]
