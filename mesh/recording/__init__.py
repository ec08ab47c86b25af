"""Recordings: objectives of unknown origin (MCAP or ROS 1 bags) checked and played, and what a device did recorded."""

from mesh.recording.conversion import bag_to_mcap
from mesh.recording.described import json_type
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
from mesh.recording.lines import InvalidLine, messages_in
from mesh.recording.objective import ChannelMessage, Objective, Played, Topic, open_objective
from mesh.recording.packing import PackSummary, pack
from mesh.recording.partial import ABOUT, CLOSED
from mesh.recording.playback import AtOnce, Clock, FixedRate, MonotonicClock, Pace, RecordedTimes, Step, paced, timeline
from mesh.recording.player import play
from mesh.recording.preflight import Preflight, preflight
from mesh.recording.rates import TopicRates, rates_of
from mesh.recording.recorder import Recorder, RecorderSettings, RecordingAbout, RecordingSummary
from mesh.recording.recorders import Recorders
from mesh.recording.recovery import RECOVERED, RecoverySummary, recover
from mesh.recording.source import Attachment, RecordingStatistics

__all__ = [
    "ABOUT",
    "CLOSED",
    "GENEROUS",
    "RECOVERED",
    "AtOnce",
    "Attachment",
    "ChannelMessage",
    "Clock",
    "CorruptRecording",
    "FixedRate",
    "InvalidLine",
    "Limits",
    "MonotonicClock",
    "NotARecording",
    "Objective",
    "Pace",
    "PackSummary",
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
