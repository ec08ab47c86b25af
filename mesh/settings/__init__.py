"""Settings: the options in groups, and how they are loaded."""

from mesh.settings.groups import (
    DEFAULTS,
    MEANING,
    OPTIONS,
    AccountNotSet,
    AccountSettings,
    ChainSettings,
    ContentSettings,
    ExecutionSettings,
    IpfsSettings,
    MarketSettings,
    NetworkSettings,
    NodeNotSet,
    Ros2Settings,
    Settings,
    StorageSettings,
    TelemetrySettings,
    ValidatorSettings,
    options_of,
)
from mesh.settings.loading import (
    NOT_OPTIONS,
    InvalidOption,
    SettingsNotToml,
    SettingsUnreadable,
    UnknownOption,
    load,
)
from mesh.settings.options import LONGEST
