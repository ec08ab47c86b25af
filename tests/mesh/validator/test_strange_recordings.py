"""Whatever numbers, texts and depths are in a recording, there is a verdict on it: no check raises an error."""

from __future__ import annotations

import json
import random
import struct
from typing import TYPE_CHECKING, Final

import msgspec
import pytest

from mesh.recording import Unrecordable
from mesh.recording._mcap import McapWriter
from mesh.validator.judging import POLICIES, Case, examine, judge, own_policy, policy_of
from mesh.validator.verification import JobFiles
from schemas import cid_of_file
from schemas.payloads import PayloadType
from tests.support.bags import Bag, BagMessage
from tests.support.validator.jobs import SampleJob, make_job
from tests.support.validator.trials import liability_of

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.validator.judging import Evidence

RECORDINGS: Final = 60
TIMES: Final = (0, 1, 10**9, (1 << 32) - 1, 1 << 32, 10**18, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
NUMBERS: Final = ("", "0", "-1", "1e5", "x", "٣", str((1 << 64) - 1), "9" * 5000, "0,18446744073709551615", "1," * 300)
TOPICS: Final = ("/say", "/said", "/aira/note", "", "/", "*", "/a\0b", "/\x1b[31m", "é" * 100, "x" * 5000)
ROLES: Final = ("objective", "device", "agent", "", "x")
DEPTH: Final = 200_000
PAYLOADS: Final = (
    b"",
    b"null",
    b"NaN",
    b"[1e999]",
    b'{"a":1e308}',
    b"9" * 400 + b".5",
    b'"\\ud800"',
    b"\xff\xfe",
    b"[" * DEPTH + b"]" * DEPTH,
    b'{"a":' * 3000 + b"1" + b"}" * 3000,
    json.dumps({"a": [1] * 10_000}).encode(),
    b"\xff\xff\xff\xff",
    b"\0\1\0\0" + b"\xff" * 40,
    struct.pack("<d", float("inf")),
    struct.pack("<d", float("nan")),
)
SCHEMAS: Final = (
    b"",
    b"null",
    b"[" * DEPTH,
    b"string data",
    b'{"type":"object","required":5,"properties":{}}',
    b'{"type":"object","required":[[1]],"properties":{"a":5}}',
    b'{"type":"object","properties":{"a":{"type":"number","minimum":1e400}}}',
    b'{"type":"integer","minimum":99999999999999999999999999,"enum":[1,"a",null]}',
    b'{"type":"string","pattern":"(a+)+$","maxLength":-1e999}',
    b'{"type":"array","items":' * 500 + b"{}" + b"}" * 500,
)
ENCODINGS: Final = ("json", "ros1", "cdr", "raw", "msgpack", "", "\0", "zenoh/int64", "zenoh/float64")
NAMES: Final = ("", "std_msgs/String", "std_msgs/msg/Float64", "sensor_msgs/Image", "a\nb", "x" * 3000)
METADATA: Final = ("aira", "aira-clock", "aira-recovered", "aira-closed", "")
FIELDS: Final = ("unix_ns", "log_ns", "seams", "messages", "liability", "agent", "objective", "topics")


def write_mcap(path: Path, dice: random.Random) -> None:
    """Write a recording of anything that MCAP allows."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=dice.choice([1, 200, 1 << 17]))
        for name in METADATA:
            for _ in range(dice.randrange(3)):
                writer.add_metadata(name, {field: dice.choice(NUMBERS) for field in dice.sample(FIELDS, 4)})
        for _ in range(dice.choice([0, 1, 5, 30])):
            of = PayloadType(dice.choice(ENCODINGS), dice.choice(NAMES), "jsonschema", dice.choice(SCHEMAS))
            times = {"log_time_ns": dice.choice(TIMES), "publish_time_ns": dice.choice(TIMES)}
            number = dice.choice([None, 0, (1 << 32) - 1])
            role = {"role": dice.choice(ROLES)}
            try:
                writer.add(dice.choice(TOPICS), dice.choice(PAYLOADS), of, metadata=role, sequence=number, **times)
            except Unrecordable:  # a topic without a name
                continue
        writer.finish()


def write_bag(path: Path, dice: random.Random, liability: str) -> None:
    """Write a bag of the job's topics, and of others."""
    topics = [f"/liability/eth_{liability}{topic}" for topic in TOPICS if topic] + ["/say"]
    times = [time for time in TIMES if time < (1 << 32) * 10**9]
    sent = [
        BagMessage(dice.choice(topics), dice.choice(PAYLOADS), dice.choice(times)) for _ in range(dice.randrange(30))
    ]
    path.write_bytes(Bag(sent, per_chunk=7).encode())


def use_all(evidence: Evidence) -> bool:
    """An own check that looks at everything."""
    seen = [(repr(one), str(one.value)[:80], one.time) for one in evidence.messages]
    return len(seen) == len(list(evidence.played)) + len(list(evidence.device)) + len(list(evidence.objective))


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_there_is_a_verdict_on_any_recording(tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str) -> None:
    dice, job = random.Random(kind), make_job(tmp_path)
    strange = tmp_path / "strange"
    policies = (*POLICIES.values(), policy_of("rate:min=1:gap=1ms"), own_policy("own", "It holds.", use_all))
    for _ in range(RECORDINGS):
        if kind == "mcap":
            write_mcap(strange, dice)
        else:
            write_bag(strange, dice, job.claim.liability)
        result = SampleJob(job.objective, strange, msgspec.structs.replace(job.claim, result=cid_of_file(strange)))
        case = Case(
            liability=liability_of(result),
            claimed=True,
            message=result.message(),
            since_ns=dice.choice(TIMES),
            until_ns=dice.choice(TIMES),
            owner_of=lambda _: "",
        )
        for objective in (job.objective, strange):
            judgement = judge(case, objective=objective, recording=strange, policies=policies, bags=True)
            assert judgement.is_decided
            assert not judgement.success
            found = examine(case.liability, JobFiles(objective=objective, result=strange), policies=policies, bags=True)
            assert any(finding.holds is False for finding in found)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []
