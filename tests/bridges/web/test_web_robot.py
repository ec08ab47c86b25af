"""The page for one robot: from options or a TOML file, and shown in the frames of other sites."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from bridges.web.cli import files_of, priced, robot_of
from mesh.amounts import XRT
from mesh.errors import InputError
from schemas import cid_of_file
from tests.support.market import MODEL
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

FULL = f'model = "{MODEL}"\nobjective = "{MODEL}"\ncost = 1500\ntitle = "The lamp"\ntext = "It blinks."\n'


def options(robot: Path | None = None, **given: str) -> dict[str, Any]:
    return {"robot": robot, "model": None, "objective": None, "cost": None} | given


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.toml"
    path.write_text(text)
    return path


def test_a_toml_file_describes_a_robots_page_and_options_change_it(tmp_path: Path) -> None:
    robot = {"model": MODEL, "objective": MODEL, "cost": "1500", "title": "The lamp", "text": "It blinks."}
    assert robot_of(options(written(tmp_path, FULL))) == robot
    assert robot_of(options(written(tmp_path, FULL), cost="7")) == robot | {"cost": "7"}
    assert robot_of(options()) is None
    alone = {"model": MODEL, "objective": None, "cost": None, "title": "", "text": ""}
    assert robot_of(options(model=MODEL)) == alone
    file = written(tmp_path, "a lamp that blinks")
    assert robot_of(options(model=str(file))) == alone | {"model": cid_of_file(file)}
    named = options(model=MODEL, objective=str(file))
    assert robot_of(named) == alone | {"objective": cid_of_file(file)}
    assert files_of(named) == [file]


@pytest.mark.parametrize(
    ("cost", "wn"), [("1", "1000000000"), ("1.5", "1500000000"), ("7wn", "7"), ("2 XRT", "2000000000"), ("", None)]
)
def test_a_robots_price_has_the_units_of_other_commands(cost: str, wn: str | None) -> None:
    robot = robot_of(options(model=MODEL, cost=cost))
    assert robot is not None
    assert priced(robot, XRT)["cost"] == wn


@pytest.mark.parametrize(
    "text",
    [
        "model = ",
        'title = "no model"',
        f'model = "{MODEL}"\ncolour = "red"',
        f'model = "{MODEL}"\ncost = "much"',
        f'model = "{MODEL}"\ncost = -1',
        f'model = "{MODEL}"\ncost = "²"',
        f'model = "{MODEL}"\nobjective = "nothing"',
        'model = "../../etc"',
    ],
)
def test_what_describes_no_page_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        robot_of(options(written(tmp_path, text)))


def test_unknown_words_are_named(tmp_path: Path) -> None:
    with raises_with(InputError, code="invalid-options", match="colour"):
        robot_of(options(written(tmp_path, FULL + 'colour = "red"')))


async def test_a_robots_page_is_shown_in_the_frames_of_the_sites_that_embed_it(serve: Any, tmp_path: Path) -> None:
    robot = robot_of(options(written(tmp_path, FULL)))
    sites = ("https://one.example", "https://two.example")
    async with serve(robot=robot, embed=sites) as browser:
        assert (await browser.get("market"))["robot"] == robot
        async with browser.session.get(browser.server.url) as response:
            policy = response.headers["Content-Security-Policy"]
            assert policy.endswith("frame-ancestors https://one.example https://two.example")
            assert "X-Frame-Options" not in response.headers
