"""What the owner of a robot lets anybody order: topics and values, declined before the handlers see them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent._owner_rules import accepted_values
from mesh.agent.hiring import DemandDeclined
from mesh.errors import ConfigurationError
from mesh.testing import assert_paid
from tests.support.signer.signers import Driver

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.testing import Market

VALUES = """
[topics."/drive"]
radius = { min = 0.2, max = 1.0 }
direction = { one_of = ["left"] }
label = { any = true, optional = true }
points = { any = true, optional = true }
"""


async def test_what_the_owner_does_not_allow_is_declined_before_the_handlers(market: Market, tmp_path: Path) -> None:
    path = tmp_path / "values.toml"
    path.write_text(VALUES)
    folder = tmp_path / "models"
    folder.mkdir()
    driver = Driver(folder, accept_values=str(path))
    seen: list[Any] = []
    driver.agent.on_demand(seen.append)
    good = {"radius": 0.5, "direction": "left"}
    async with market.robot(driver.agent):
        for message, code in (
            (("/drive", good | {"radius": 1.5}), "value-not-allowed"),
            (("/drive", good | {"direction": "right"}), "value-not-allowed"),
            (("/drive", good | {"turbo": 1}), "field-not-allowed"),
            (("/speed", 1.0), "topic-not-allowed"),
        ):
            for by in (driver.agent, driver.model):  # for this robot alone, and published
                with pytest.raises(DemandDeclined) as caught:
                    await market.demand(by, [message], cost="1 XRT")
                assert caught.value.declines[0].code == code
            (quote,) = await (await market.person()).quotes(driver.model, [message])
            assert quote.code == code
        assert seen == []
        assert_paid(await market.order(driver.agent, [("/drive", good)], cost="1 XRT"))
        assert len(seen) == 1
    assert len(driver.begun) == 1


@pytest.mark.parametrize(
    ("text", "why"),
    [("[topic]", "unknown"), ("", "no topic is allowed"), ('[topics."/a"]\nx = { min = "1" }', "min is a number")],
)
def test_a_file_with_mistakes_is_refused_at_the_start(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "values.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match="accept_values") as caught:
        accepted_values(str(path))
    assert why in str(caught.value)
    with pytest.raises(ConfigurationError, match="accept_values"):
        accepted_values(str(tmp_path / "none.toml"))
