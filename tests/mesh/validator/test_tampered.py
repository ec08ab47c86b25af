"""A hundred recordings that were tampered with: none is paid, each for its reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.validator.trials import failed
from tests.support.validator.verdicts import judge_tampered

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter


async def test_none_of_a_hundred_tampered_recordings_is_paid(router: EmbeddedRouter, tmp_path: Path) -> None:
    verdicts = await judge_tampered(router.endpoint, tmp_path)
    assert len({one.tampering.kind for one in verdicts}) == len(verdicts) >= 100
    assert [one.tampering.kind for one in verdicts if one.judgement.success] == []
    other_reasons = {
        one.tampering.kind: (one.tampering.code, failed(one.judgement))
        for one in verdicts
        if one.tampering.code not in failed(one.judgement)
    }
    assert other_reasons == {}
