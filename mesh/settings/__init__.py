"""Settings: the options in groups, and how they are loaded."""

from mesh.settings._loading import NOT_OPTIONS, load
from mesh.settings.groups import (
    DEFAULTS,
    LONGEST,
    MEANING,
    OPTIONS,
    AccountSettings,
    ChainSettings,
    ContentSettings,
    EdgeSettings,
    ExecutionSettings,
    IpfsSettings,
    MarketSettings,
    NetworkSettings,
    ProfileSettings,
    Ros2Settings,
    Settings,
    StorageSettings,
    TelemetrySettings,
    ValidatorSettings,
    options_of,
)
