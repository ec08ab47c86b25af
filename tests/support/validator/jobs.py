"""A job with its two files, and ways to forge the recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.recording import Recorder, RecordingAbout, open_objective
from mesh.recording._mcap import McapWriter
from mesh.validator.verification import Claim, JobFiles, Verdict, verify
from schemas import Result, Signer, String, cid_of_file, encode
from schemas.payloads import STRING
from tests.support.objectives import objective

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mesh.recording import ChannelMessage

ROBOT: Final = Signer(b"\x01" * 32)
THIEF: Final = Signer(b"\x02" * 32)
LIABILITY: Final = "0x" + "1" * 40
OTHER: Final = "0x" + "2" * 40
WORDS: Final = ("one", "two", "three", "four", "five")

Metadata = dict[str, dict[str, str]]


@dataclass
class SampleJob:
    """The files of a job, and the claim of its contract."""

    objective: Path
    result: Path
    claim: Claim

    def verify(self, message: bytes | None = None, **claimed: Any) -> Verdict:
        """Verify the job, with these fields of the claim changed."""
        claim = msgspec.structs.replace(self.claim, **claimed)
        return verify(claim, JobFiles(objective=self.objective, result=self.result, message=message))

    def forge(self, change: Callable[[list[ChannelMessage], Metadata], list[ChannelMessage]]) -> None:
        """Rewrite the recording with changed messages and metadata, as a valid file with its own CID."""
        old = open_objective(self.result)
        metadata = {name: dict(values) for name, values in old.metadata.items()}
        written = change(list(old.in_file_order()), metadata)
        with self.result.open("wb") as stream:
            writer = McapWriter(stream)
            for name, values in metadata.items():
                writer.add_metadata(name, values)
            for one in written:
                message = one.message
                writer.add(
                    message.topic,
                    message.payload,
                    message.type,
                    metadata={"role": message.role},
                    log_time_ns=message.log_time_ns,
                    publish_time_ns=message.publish_time_ns,
                    sequence=message.sequence,
                )
            writer.finish()
        self.claim = msgspec.structs.replace(self.claim, result=cid_of_file(self.result))

    def message(self, signer: Signer = ROBOT, **fields: Any) -> bytes:
        """The encoded signed Result."""
        said: dict[str, Any] = {"liability": LIABILITY, "result": cid_of_file(self.result), "success": True} | fields
        return encode(signer.sign(Result(**said)))


def make_job(folder: Path, *, played: tuple[str, ...] = WORDS, topics: str = "", **about: str) -> SampleJob:
    """A job whose objective has five messages on `/say`, of which these were `played`; the device answered each."""
    path = folder / "objective.mcap"
    path.write_bytes(objective(*(("/say", word) for word in WORDS), ("/stop", b"")))
    says = {"liability": LIABILITY, "agent": ROBOT.address, "lighthouse": OTHER, "objective": cid_of_file(path)} | about
    with Recorder(folder / "result.mcap", RecordingAbout(**says, topics=topics)) as recorder:
        record(recorder, played, answered=not topics)
        if played == WORDS and not topics:
            stop(recorder)
    claim = Claim(
        liability=LIABILITY,
        promisor=ROBOT.address,
        lighthouse=OTHER,
        objective=cid_of_file(path),
        result=cid_of_file(folder / "result.mcap"),
        success=True,
        finalized=True,
    )
    return SampleJob(path, folder / "result.mcap", claim)


def record(recorder: Recorder, words: tuple[str, ...], *, answered: bool = True) -> None:
    """Play these words, each answered by the device."""
    for word in words:
        recorder.record("/say", String(word).encode(), STRING, role="objective")
        if answered:
            recorder.record("/said", String(word).encode(), STRING, role="device")


def stop(recorder: Recorder) -> None:
    """Play the last message of the objective."""
    last = list(open_objective(recorder.path.with_name("objective.mcap")).messages())[-1]
    recorder.record(last.topic, last.payload, last.type, role="objective")


def failures(verdict: Verdict) -> dict[str, str]:
    """The findings that do not hold, with their details."""
    return {finding.name: finding.detail for finding in verdict.findings if finding.holds is False}


def renumbered(messages: list[ChannelMessage]) -> list[ChannelMessage]:
    """The same messages with sequence numbers without gaps and times in order."""
    counts: dict[str, int] = {}
    times = sorted(one.message.log_time_ns for one in messages)
    numbered = []
    for one, time in zip(messages, times, strict=True):
        number = counts[one.message.topic] = counts.get(one.message.topic, -1) + 1
        message = msgspec.structs.replace(one.message, sequence=number, log_time_ns=time, publish_time_ns=time)
        numbered.append(msgspec.structs.replace(one, message=message))
    return numbered
