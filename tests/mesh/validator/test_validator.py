"""Whole jobs with a validator: what it says is what is paid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.validator.courts import FEE, PRICE, Court

if TYPE_CHECKING:
    from tests.support.market import Place


async def test_a_validated_job_is_paid_in_generation_3(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()
        async with court.at_work(validator, robot) as person:
            before = await place.balance("robot")
            contract = await court.demand(person, validator.address)
            outcome = await contract.outcome()
            assert outcome.success
            assert await place.balance("robot") == before + PRICE
