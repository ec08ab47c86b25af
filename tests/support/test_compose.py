from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.compose import Project
from tests.support.containers import BASE_IMAGE, Engine, EngineFailed, engine
from tests.support.waiting import at_most, until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["engine"]

pytestmark = pytest.mark.compose

COMPOSE = f"""
services:
  web:
    image: {BASE_IMAGE}
    command: ["python3", "-u", "-m", "http.server", "8000", "--directory", "/data"]
    stop_signal: SIGINT
    volumes: ["data:/data"]
  asker:
    image: {BASE_IMAGE}
    depends_on: [web]
    command: ["sleep", "infinity"]
    stop_signal: SIGKILL
volumes:
  data: {{}}
"""
ASK = "import urllib.request as r; print(r.urlopen('http://web:8000/${FILE}', timeout=1).status)"


@pytest.fixture(scope="module")
def project(engine: Engine, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    folder = tmp_path_factory.mktemp("compose")
    (folder / "compose.yml").write_text(COMPOSE)
    with Project(engine, folder, files=[folder / "compose.yml"]) as running:
        running.up()
        yield running


def is_answered(project: Project, file: str = "") -> bool:
    try:
        # A name that no container has is looked up outside, for as long as that takes.
        return project.execute("asker", "timeout", "3", "python3", "-c", ASK.replace("${FILE}", file)) == "200\n"
    except EngineFailed:
        return False


async def test_services_find_each_other_by_name_and_their_logs_are_kept(project: Project) -> None:
    await until(lambda: is_answered(project), what="an answer of web")
    await until(lambda: '"GET / HTTP/1.1" 200' in project.log("web"), what="its log")


async def test_a_killed_service_comes_back_with_its_state(project: Project) -> None:
    project.execute("web", "touch", "/data/kept")
    project.kill("web")
    assert not is_answered(project)
    project.start("web")
    await until(lambda: is_answered(project, "kept"), what="an answer of web")


async def test_a_paused_service_does_not_answer_until_it_is_resumed(project: Project) -> None:
    project.pause("web")
    assert not is_answered(project)
    project.unpause("web")
    await until(lambda: is_answered(project), what="an answer of web")


async def test_a_disconnected_service_is_unreachable_until_it_is_reconnected(project: Project) -> None:
    project.disconnect("web")
    assert not is_answered(project)
    assert project.is_running("web")
    project.connect("web")
    await until(lambda: is_answered(project), what="an answer of web")


def test_down_leaves_nothing_and_neither_does_removal_by_force(engine: Engine, tmp_path: Path) -> None:
    (tmp_path / "compose.yml").write_text(COMPOSE)
    with Project(engine, tmp_path, files=[tmp_path / "compose.yml"]) as project:
        project.up()
        kinds = {left.split()[0] for left in project.leftovers()}
        assert kinds == {"container", "volume", "network"}
        project.down()
        assert project.leftovers() == []
        project.up()
        project.pause("web")
    assert project.leftovers() == []


def test_a_command_that_takes_too_long_is_killed_with_its_children(engine: Engine) -> None:
    with at_most(10), pytest.raises(EngineFailed, match=r"sleep 60: took longer than 0\.5 s\nfirst words"):
        engine.run(["sh", "-c", "echo first words; sleep 60; true sleep 60"], seconds=0.5)


def test_the_error_of_a_failed_command_has_the_output_of_docker(engine: Engine) -> None:
    with pytest.raises(EngineFailed, match=r"ended with 1\n.*No such container"):
        engine("logs", "aira-nobody")
