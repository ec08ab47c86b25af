"""Recordings whose bytes or messages were tampered with."""

from __future__ import annotations

import gzip
import shutil

from schemas import Empty, String
from schemas.payloads import RAW, STRING, PayloadType
from tests.support.validator.forging import (
    Forgery,
    both,
    by_another_writer,
    changed,
    covered,
    naive,
    raw,
    signed,
    swapped,
)
from tests.support.validator.tampering import (
    SECOND,
    Kinds,
    as_bag,
    at,
    copied,
    dropped,
    edited,
    flipped,
    flooded,
    late_answers,
    number_payload,
    numbered,
    recovered_file,
    second_half_dropped,
    state_payload,
)


def cut_files() -> Kinds:
    """Files that are cut, damaged or not recordings of ours."""
    return {
        "its last byte is cut off": ("complete/readable", raw(lambda data: data[:-1])),
        "its index is cut off": ("complete/readable", raw(lambda data: data[:-300])),
        "its second half is cut off": ("complete/readable", raw(lambda data: data[: len(data) // 2])),
        "only its first bytes are left": ("complete/readable", raw(lambda data: data[:64])),
        "the file is empty": ("complete/readable", raw(lambda data: b"")),
        "it is a text": ("complete/readable", raw(lambda data: b"the lamp shone, I swear")),
        "a bit of a message is flipped": (
            "complete/readable",
            raw(lambda data: flipped(data, b"\x28\xb5\x2f\xfd", 40)),
        ),
        "a bit of the index is flipped": (
            "complete/readable",
            raw(lambda data: data[:-60] + bytes([data[-60] ^ 1]) + data[-59:]),
        ),
        "bytes are added behind its end": ("complete/readable", raw(lambda data: data + b"more")),
        "two copies of it are joined": ("complete/readable", raw(lambda data: data + data)),
        "bytes are lost in its middle": ("complete/readable", raw(lambda data: data[:600] + data[640:])),
        "it is compressed as a whole": ("complete/readable", raw(gzip.compress)),
        "its checksums are removed": ("complete/readable", by_another_writer(enable_crcs=False)),
        "its messages are outside of chunks": ("complete/readable", by_another_writer(use_chunking=False)),
        "its statistics are removed": ("complete/statistics", by_another_writer(use_statistics=False)),
        "it is cut, and recovered by hand": ("complete/closed", recovered_file),
        "it is another format, a ROS 1 bag": ("complete/statistics", as_bag),
        "it is the objective": (
            "complete/liability",
            lambda job: (shutil.copy(job.objective, job.recording), signed(job))[1],
        ),
    }


def missing_messages() -> Kinds:
    """Messages that are dropped, added, copied, moved."""
    return {
        "the last message is dropped": ("complete/closed", naive(lambda f: f.drop(len(f.messages) - 1))),
        "the first message is dropped": ("complete/sequence", naive(lambda f: f.drop(0))),
        "an answer is dropped": ("complete/sequence", naive(dropped("/lamp/state", 7))),
        "an answer is dropped, traces covered up": ("acknowledged/answers", covered(dropped("/lamp/state", 7))),
        "all answers are dropped, traces covered up": (
            "acknowledged/answers",
            covered(lambda f: f.drop_all("/lamp/state")),
        ),
        "a command is dropped": ("complete/sequence", naive(dropped("/lamp", 5))),
        "a command is dropped, traces covered up": ("complete/played", covered(dropped("/lamp", 5))),
        "the last command is dropped, traces covered up": ("complete/played", covered(dropped("/lamp", -1))),
        "the second half is dropped": ("complete/closed", naive(second_half_dropped)),
        "the second half is dropped, traces covered up": (
            "complete/played",
            covered(second_half_dropped),
        ),
        "the first half is dropped, traces covered up": ("complete/played", covered(lambda f: f.drop(*range(30)))),
        "all messages are dropped": ("complete/closed", naive(lambda f: f.messages.clear())),
        "all messages are dropped, traces covered up": ("complete/played", covered(lambda f: f.messages.clear())),
        "all of the device is dropped, traces covered up": (
            "rate/rate",
            covered(lambda f: f.drop_all("/lamp/state", "/lamp/temperature")),
        ),
        "a message is there twice": ("complete/sequence", naive(copied(4))),
        "a message is there twice, traces covered up": ("complete/duplicates", covered(copied(4))),
        "a command is repeated, traces covered up": (
            "complete/played",
            covered(at("/lamp", 4, lambda f, place: copied(place, after_ns=1000)(f))),
        ),
        "a command is added, traces covered up": (
            "complete/played",
            covered(at("/lamp", 4, lambda f, place: copied(place, after_ns=1000, payload=number_payload(0.99))(f))),
        ),
        "a command is added at the end, traces covered up": (
            "complete/played",
            covered(lambda f: f.messages.append(f.messages[f.on("/lamp")[-1]])),
        ),
        "two commands are exchanged": ("complete/sequence", naive(lambda f: swapped(*f.on("/lamp")[3:5])(f))),
        "two commands are exchanged, traces covered up": (
            "complete/played",
            covered(lambda f: swapped(*f.on("/lamp")[3:5])(f)),
        ),
        "messages of two topics are exchanged": (
            "complete/times",
            naive(lambda f: swapped(f.on("/lamp/state")[3], f.on("/lamp/temperature")[9])(f)),
        ),
        "messages are in the reverse order": ("complete/times", naive(lambda f: f.messages.reverse())),
        "the numbers of messages begin at 1": (
            "complete/sequence",
            naive(numbered(lambda number: number + 1)),
        ),
        "all messages have the number 0": (
            "complete/sequence",
            naive(numbered(lambda number: 0)),
        ),
    }


def forged_messages() -> Kinds:
    """Messages that are altered, or said to be somebody else's."""
    return {
        "a command has another value": ("complete/played", naive(edited("/lamp", 6, payload=number_payload(0.99)))),
        "a command has another type": (
            "complete/played",
            naive(edited("/lamp", 6, type=PayloadType("ros1", "std_msgs/Float32", "ros1msg", b"float32 data\n"))),
        ),
        "a command has another encoding": ("complete/played", naive(edited("/lamp", 6, type=RAW), Forgery.cover_up)),
        "a command is on another topic": ("complete/played", covered(edited("/lamp", 6, topic="/lamp2"))),
        "all commands are on another topic": (
            "complete/played",
            covered(lambda f: f.edit_all("/lamp", topic="/lamps")),
        ),
        "the answers are on another topic": (
            "acknowledged/answers",
            covered(lambda f: f.edit_all("/lamp/state", topic="/lamp/said")),
        ),
        "the temperatures are on another topic": (
            "rate/rate",
            covered(lambda f: f.edit_all("/lamp/temperature", topic="/oven/temperature")),
        ),
        "commands are said to be the device's": (
            "complete/played",
            covered(lambda f: f.edit_all("/lamp", role="device")),
        ),
        "answers are said to be commands": (
            "complete/played",
            covered(lambda f: f.edit_all("/lamp/state", role="objective")),
        ),
        "a message of the device passes for a command": (
            "complete/played",
            covered(
                edited("/lamp", 6, role="device"),
                copied(2, role="objective", topic="/lamp", payload=number_payload(0.3)),
            ),
        ),
        "the device's messages are the agent's": (
            "complete/roles",
            covered(lambda f: f.edit_all("/lamp/state", role="agent")),
        ),
        "messages have an unknown role": (
            "complete/roles",
            covered(lambda f: f.edit_all("/lamp/state", role="witness")),
        ),
        "messages have no role": ("complete/roles", covered(lambda f: f.edit_all("/lamp/temperature", role=""))),
        "a temperature is beyond the model's range": (
            "schema/model",
            naive(edited("/lamp/temperature", 3, payload=number_payload(500))),
        ),
        "a temperature is no number": (
            "schema/finite",
            naive(edited("/lamp/temperature", 3, payload=number_payload(float("nan")))),
        ),
        "a temperature is infinite": (
            "schema/finite",
            naive(edited("/lamp/temperature", 3, payload=number_payload(float("inf")))),
        ),
        "a temperature is cut off": ("schema/types", naive(edited("/lamp/temperature", 3, payload=b"\0\0"))),
        "the temperatures are texts": (
            "schema/model",
            naive(lambda f: f.edit_all("/lamp/temperature", payload=String("20.5").encode(), type=STRING)),
        ),
        "the temperatures are empty messages": (
            "schema/model",
            naive(lambda f: f.edit_all("/lamp/temperature", payload=b"", type=Empty.type)),
        ),
        "the temperatures are bytes without a type": (
            "schema/model",
            naive(lambda f: f.edit_all("/lamp/temperature", type=RAW)),
        ),
        "a state is beyond its schema's range": (
            "schema/limits",
            naive(edited("/lamp/state", 3, payload=state_payload(level=7.5))),
        ),
        "a state has a text for a number": (
            "schema/limits",
            naive(edited("/lamp/state", 3, payload=state_payload(level="bright"))),
        ),
        "a state lacks a field": ("schema/limits", naive(edited("/lamp/state", 3, payload=b'{"mode":"on"}'))),
        "a state is not JSON": ("schema/types", naive(edited("/lamp/state", 3, payload=b'{"level":0.15'))),
        "a state is of a type that nobody can decode": (
            "schema/types",
            covered(edited("/lamp/state", 3, type=PayloadType("secret", "lamp"))),
        ),
        "a required topic is missing": ("schema/model", covered(lambda f: f.drop_all("/lamp/temperature"))),
        "answers come seven seconds late": (
            "acknowledged/answers",
            both(naive(late_answers), changed(until_ns=lambda job: job.until_ns + 7 * SECOND)),
        ),
        "answers come before their commands": (
            "acknowledged/answers",
            covered(lambda f: f.messages.sort(key=lambda one: one.role)),
        ),
        "most temperatures are dropped, traces covered up": (
            "rate/rate",
            covered(dropped("/lamp/temperature", *range(1, 19))),
        ),
        "thousands of temperatures are added": ("rate/rate", covered(flooded)),
        "seven seconds are silent": ("rate/gaps", covered(late_answers)),
        "a forged answer shows another level": (
            "levels/check",
            naive(edited("/lamp/state", 3, payload=state_payload(level=0.9))),
        ),
        "all forged answers are the same": (
            "levels/check",
            naive(lambda f: f.edit_all("/lamp/state", payload=state_payload(level=0.5))),
        ),
        "forged answers show nothing": (
            "levels/check-failed",
            naive(lambda f: f.edit_all("/lamp/state", payload=b"{}")),
        ),
    }
