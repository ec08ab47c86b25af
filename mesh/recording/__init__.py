"""Recordings: objectives of unknown origin (MCAP, ROS 1 bags, rosbag2) checked and played, and jobs recorded."""

from mesh.recording._bag_reader import is_bag
from mesh.recording._converting import (
    ConversionSummary,
    PackSummary,
    RecordingFormat,
    convert,
    described_line,
    messages_in,
    pack,
    pack_described,
    pack_values,
    recording_file,
    recording_files,
)
from mesh.recording._json_schemas import JsonSchemas, encode_described, json_type
from mesh.recording._recorder import (
    ABOUT,
    CLOCK_RECORD,
    CLOSED,
    NOTE_TOPIC,
    MessageRole,
    Recorder,
    Recorders,
    RecorderSettings,
    RecordingAbout,
    RecordingSummary,
)
from mesh.recording._recovery import RECOVERED, recover
from mesh.recording._source import (
    GENEROUS,
    Attachment,
    CorruptRecording,
    Limits,
    NotARecording,
    RecordingError,
    RecordingFailed,
    Unrecordable,
)
from mesh.recording.objective import (
    ChannelMessage,
    Objective,
    Played,
    TopicRates,
    json_messages,
    numbers_of,
    open_objective,
    preflight,
    rates_of,
    shown_value,
)
from mesh.recording.playback import AT_ONCE, paced, play
