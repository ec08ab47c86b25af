"""Validators: what of tampered and honest recordings is paid, how long judging takes, and what it costs on the chain.

Exits with 1 if a tampered recording is paid, an honest one is not, or judging takes too long. The recordings are those
of the tests (`docs/reference/tampered-recordings.md` lists them), the gas is that of `bench/gas.py`. With `--chain` the
tampered ones are also handed in for contracts on a chain, by jobs with router, provider and validator.
"""

from __future__ import annotations

import asyncio
import logging
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the robots of the tests

from common import arguments, show
from mesh.recording import Recorder, RecordingAbout, json_type
from schemas import cid_of_file
from schemas.payloads import RAW, encode_value
from tests.support.contracts.gas import measure
from tests.support.routers import EmbeddedRouter
from tests.support.validator.chain_jobs import UNHEARD, hand_in_tampered
from tests.support.validator.lamps import (
    LIGHTHOUSE,
    POLICIES,
    ROBOT,
    SLACK_NS,
    FinishedJob,
    LampState,
    contract,
    order,
    signed_by,
)
from tests.support.validator.verdicts import judge_honest, judge_tampered

if TYPE_CHECKING:
    from mesh.validator.judging import Policy

ROUNDS: Final = 5
SECONDS: Final = 3.0
"""Seconds that judging a recording of 10 MB by all policies may take."""
RATIO: Final = 3.0
"""How many times longer all policies may take than `complete` alone."""
COMMANDS: Final = 1000
PICTURE: Final = 4900
"""Bytes of a message of the camera; two of them come with each answer."""
FINALIZED: Final = {
    "gas": "finalize_cost",
    "gas_validated": "finalize_1_juror",
    "gas_2_of_3_jurors": "finalize_2_of_3",
}


def large_job(folder: Path, megabytes: int) -> FinishedJob:
    """A job whose recording has about that many megabytes."""
    commands = COMMANDS * megabytes // 10
    levels = tuple(number / commands for number in range(commands))
    objective = order(folder / "large.mcap", levels)
    liability, since, path, kind = (
        contract("large", objective),
        time.time_ns(),
        folder / "result.mcap",
        json_type(LampState),
    )
    about = RecordingAbout(
        liability=liability.address, agent=ROBOT.address, lighthouse=LIGHTHOUSE, objective=liability.objective
    )
    with Recorder(path, about) as recorder:
        for number, level in enumerate(levels):
            recorder.record("/lamp", *encode_value(level), role="objective")
            recorder.record("/lamp/temperature", *encode_value(20.0 + level))
            recorder.record("/camera", os.urandom(PICTURE), RAW)
            recorder.record("/camera", os.urandom(PICTURE), RAW)
            recorder.record("/lamp/state", b'{"level":%r,"mode":"on"}' % level, kind)
            if number % 100 == 0:
                recorder.sync().result()
    message = signed_by(ROBOT, liability.address, cid_of_file(path))
    return FinishedJob(liability, objective, path, message, since - SLACK_NS, time.time_ns() + SLACK_NS)


def seconds_to_judge(job: FinishedJob, policies: tuple[Policy, ...]) -> float:
    """The seconds of the fastest of several rounds."""
    best = float("inf")
    for _ in range(ROUNDS):
        began = time.perf_counter()
        judgement = job.judge({}, policies)
        best = min(best, time.perf_counter() - began)
        wrong = [finding for finding in judgement.failures if finding.policy != "rate"]  # it was recorded at once
        assert not wrong, wrong
    return best


def measure_judging(folder: Path, megabytes: int) -> dict[str, float]:
    """How long it takes to judge a recording, by one policy and by all."""
    job = large_job(folder, megabytes)
    one, every = seconds_to_judge(job, ()), seconds_to_judge(job, POLICIES)
    return {
        "recording_mb": round(job.recording.stat().st_size / 1e6, 1),
        "seconds_one_policy": round(one, 3),
        f"seconds_{1 + len(POLICIES)}_policies": round(every, 3),
        "ratio": round(every / one, 2),
    }


def measure_verdicts(folder: Path) -> dict[str, float]:
    """How many tampered recordings are paid, and which part of the honest ones."""
    (folder / "tampered").mkdir()
    (folder / "honest").mkdir()
    router = EmbeddedRouter()
    router.start()
    try:
        tampered = asyncio.run(judge_tampered(router.endpoint, folder / "tampered"))
        honest = asyncio.run(judge_honest(router.endpoint, folder / "honest"))
    finally:
        router.stop()
    for one in honest:
        if not one.judgement.success:
            print(f"not paid: {one.kind.kind}: {one.judgement.failures}", file=sys.stderr)
    return {
        "tampered": len(tampered),
        "tampered_paid": sum(one.judgement.success for one in tampered),
        "honest": len(honest),
        "honest_paid": sum(one.judgement.success for one in honest) / len(honest),
    }


def measure_chain(folder: Path) -> dict[str, int]:
    """How contracts end for which tampered recordings are handed in; `refused` are those with the expected reason."""
    (folder / "chain").mkdir()
    with EmbeddedRouter() as router:
        jobs = asyncio.run(hand_in_tampered(router.endpoint, folder / "chain"))
    refused = [job for job in jobs if job.tampering.code in job.codes and not job.liability.is_success]
    return {
        "chain_jobs": len(jobs),
        "chain_paid": sum(job.liability.is_success for job in jobs),
        "chain_judged": sum(job.tampering.kind not in UNHEARD for job in jobs),
        "chain_refused": len(refused),
        "chain_refunded": sum(job.liability.is_finalized and not job.liability.is_success for job in jobs),
    }


def measure_gas() -> dict[str, int]:
    """The gas of finalizing without a validator, by one, and by two of three jurors, by generation."""
    gas = measure()
    return {f"{name}_{generation}": used for name, row in FINALIZED.items() for generation, used in gas[row].items()}


def missed(results: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    slow = next(value for name, value in results.items() if name.endswith("_policies"))
    bars = {
        "tampered_paid": results["tampered_paid"] == 0,
        "honest_paid": results["honest_paid"] == 1.0,
        "chain_paid": results.get("chain_paid", 0) == 0,
        "chain_refunded": results.get("chain_refunded") == results.get("chain_jobs"),
        "chain_refused": results.get("chain_refused") == results.get("chain_judged"),
        f"judging takes {slow} s, more than {SECONDS}": slow <= SECONDS,
        f"all policies take {results['ratio']} times as long as one": results["ratio"] <= RATIO,
    }
    return [bar for bar, is_met in bars.items() if not is_met]


def main() -> int:
    """Run from the command line; returns 1 if a bar is missed."""
    options = arguments(__doc__.splitlines()[0], megabytes=10, chain=False)
    logging.disable(logging.ERROR)  # own checks that fail on tampered recordings say so
    with tempfile.TemporaryDirectory(prefix="aira-bench-") as name:
        folder = Path(name)
        results = {**measure_judging(folder, options.megabytes), **measure_verdicts(folder), **measure_gas()}
        results |= measure_chain(folder) if options.chain else {}
    show(results, as_json=options.json)
    for bar in missed(results):
        print(bar, file=sys.stderr)
    return 1 if missed(results) else 0


if __name__ == "__main__":
    sys.exit(main())
