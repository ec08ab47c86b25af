"""Recordings: objectives of unknown origin (MCAP or ROS 1 bags) checked and played, and what a device did recorded."""

from mesh.recording.conversion import bag_to_mcap
from mesh.recording.errors import (
    CorruptRecording,
    NotARecording,
    RecordingError,
    RecordingExists,
    RecordingFailed,
    RecordingTooLarge,
    Unrecordable,
)
from mesh.recording.limits import Limits
from mesh.recording.objective import Objective, Played, Topic, open_objective
from mesh.recording.playback import AtOnce, Clock, MonotonicClock, Pace, Rate, RecordedTimes, Step, paced, timeline
from mesh.recording.player import play
from mesh.recording.preflight import Preflight, preflight
from mesh.recording.recorder import Recorder, RecorderSettings, RecordingAbout, RecordingSummary
from mesh.recording.recovery import Recovered, recover

__all__ = [
    "AtOnce",
    "Clock",
    "CorruptRecording",
    "Limits",
    "MonotonicClock",
    "NotARecording",
    "Objective",
    "Pace",
    "Played",
    "Preflight",
    "Rate",
    "RecordedTimes",
    "Recorder",
    "RecorderSettings",
    "RecordingAbout",
    "RecordingError",
    "RecordingExists",
    "RecordingFailed",
    "RecordingSummary",
    "RecordingTooLarge",
    "Recovered",
    "Step",
    "Topic",
    "Unrecordable",
    "bag_to_mcap",
    "open_objective",
    "paced",
    "play",
    "preflight",
    "recover",
    "timeline",
]
