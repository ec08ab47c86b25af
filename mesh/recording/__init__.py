"""Recordings: objectives of unknown origin (MCAP or ROS 1 bags) checked and played, and jobs recorded."""

from mesh.recording.errors import (
    CorruptRecording,
    NotARecording,
    RecordingError,
    RecordingExists,
    RecordingFailed,
    RecordingTooLarge,
    Unrecordable,
)
from mesh.recording.limits import GENEROUS, Limits
from mesh.recording.objective import (
    ChannelMessage,
    Objective,
    Played,
    Topic,
    TopicRates,
    json_type,
    open_objective,
    rates_of,
)
from mesh.recording.packing import InvalidLine, PackSummary, bag_to_mcap, messages_in, pack
from mesh.recording.partial import ABOUT, CLOCK_RECORD, CLOSED, RecordingAbout
from mesh.recording.playback import (
    AtOnce,
    FixedRate,
    MonotonicClock,
    Pace,
    PlaybackClock,
    RecordedTimes,
    Step,
    paced,
    play,
    timeline,
)
from mesh.recording.preflight import Preflight, preflight
from mesh.recording.recorder import Recorder, RecorderSettings, RecordingSummary
from mesh.recording.recorders import Recorders
from mesh.recording.recovery import RECOVERED, RecoverySummary, recover
from mesh.recording.source import Attachment, RecordingStatistics

__all__ = [
    "ABOUT",
    "CLOCK_RECORD",
    "CLOSED",
    "GENEROUS",
    "RECOVERED",
    "AtOnce",
    "Attachment",
    "ChannelMessage",
    "CorruptRecording",
    "FixedRate",
    "InvalidLine",
    "Limits",
    "MonotonicClock",
    "NotARecording",
    "Objective",
    "Pace",
    "PackSummary",
    "PlaybackClock",
    "Played",
    "Preflight",
    "RecordedTimes",
    "Recorder",
    "RecorderSettings",
    "Recorders",
    "RecordingAbout",
    "RecordingError",
    "RecordingExists",
    "RecordingFailed",
    "RecordingStatistics",
    "RecordingSummary",
    "RecordingTooLarge",
    "RecoverySummary",
    "Step",
    "Topic",
    "TopicRates",
    "Unrecordable",
    "bag_to_mcap",
    "json_type",
    "messages_in",
    "open_objective",
    "paced",
    "pack",
    "play",
    "preflight",
    "rates_of",
    "recover",
    "timeline",
]
