"""Recordings: objectives of unknown origin (MCAP, ROS 1 bags, rosbag2) checked and played, and jobs recorded."""

from mesh.recording.converting import (
    ConversionSummary,
    RecordingFormat,
    Unconvertible,
    convert,
    recording_file,
    recording_files,
)
from mesh.recording.errors import (
    CorruptRecording,
    NotARecording,
    RecordingError,
    RecordingExists,
    RecordingFailed,
    RecordingTooLarge,
    Unrecordable,
)
from mesh.recording.json_schemas import JsonSchemas, encode_described, json_type
from mesh.recording.limits import GENEROUS, Limits
from mesh.recording.objective import (
    ChannelMessage,
    Objective,
    Played,
    TopicRates,
    open_objective,
    rates_of,
)
from mesh.recording.packing import InvalidLine, PackSummary, bag_to_mcap, messages_in, pack, pack_values
from mesh.recording.partial import ABOUT, CLOCK_RECORD, CLOSED, NOTE_TOPIC, MessageRole, RecordingAbout
from mesh.recording.playback import (
    AtOnce,
    FixedRate,
    Pace,
    RecordedTimes,
    paced,
    play,
    timeline,
)
from mesh.recording.preflight import preflight
from mesh.recording.recorder import Recorder, RecorderSettings, RecordingSummary
from mesh.recording.recorders import Recorders
from mesh.recording.recovery import RECOVERED, recover
from mesh.recording.source import Attachment
from mesh.recording.values import numbers_of
