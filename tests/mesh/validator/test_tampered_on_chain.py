"""Robots that hand in tampered recordings on a chain: none is paid, each is refunded for its reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.validator.chain_jobs import UNHEARD, hand_in_tampered

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

SAMPLE = (
    "its second half is cut off",
    "a forged answer shows another level",
    "it is of another job, renamed to this one",
)
MORE = (
    "a message is there twice, traces covered up",
    "all messages have the number 0",
    "answers are said to be commands",
    "the temperatures are texts",
    "it names no liability",
    "its recorder lost messages",
    "it states a crash without a new begin",
    "it is from yesterday",
    "the Result names another recording",
    "it is of another robot's job",
)
"""`python bench/validator.py --chain` hands in all of them."""


@pytest.mark.parametrize("kinds", [SAMPLE, pytest.param(MORE, marks=pytest.mark.full)], ids=["sample", "more"])
async def test_no_tampered_recording_is_paid_on_a_chain(
    router: EmbeddedRouter, tmp_path: Path, kinds: tuple[str, ...]
) -> None:
    jobs = await hand_in_tampered(router.endpoint, tmp_path, kinds)
    assert {job.tampering.kind for job in jobs} == set(kinds)
    assert all(job.liability.is_finalized and not job.liability.is_success for job in jobs)
    judged = [job for job in jobs if job.tampering.kind not in UNHEARD]
    assert {job.tampering.kind: job.codes for job in judged if job.tampering.code not in job.codes} == {}
    assert [job.tampering.kind for job in jobs if job.codes and job not in judged] == []
