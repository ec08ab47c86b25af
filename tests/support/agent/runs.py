"""Runs on a router of the test's own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest
import zenoh

from mesh.agent.jobs import JobRun
from mesh.recording import AT_ONCE, Recorder, RecorderSettings, RecordingAbout, open_objective
from tests.support.agent.samples import job
from tests.support.routers import EmbeddedRouter, client_config

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.recording import Objective

AGENT = "0x" + "ab" * 20


@pytest.fixture
def session(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """The agent's session."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened


class Making:
    """Makes runs in a folder."""

    def __init__(self, session: zenoh.Session, folder: Path) -> None:
        self.session = session
        self._folder = folder
        self.path = folder / "run.mcap"

    def run(
        self,
        content: bytes = b"",
        *,
        position: int = 0,
        topics: frozenset[str] | None = None,
        speed: float = AT_ONCE,
        queue_bytes: int = 64 << 20,
    ) -> JobRun:
        """A run of the objective in `content`, not yet open."""
        played: Objective | None = None
        if content:
            (self._folder / "objective.mcap").write_bytes(content)
            played = open_objective(self._folder / "objective.mcap")
        return JobRun(
            self.session,
            AGENT,
            msgspec.structs.replace(job(), position=position),
            Recorder(self.path, RecordingAbout(), settings=RecorderSettings(queue_bytes=queue_bytes)),
            objective=played,
            speed=speed,
            recorded=topics,
        )

    def recorded(self) -> list[tuple[str, bytes, str]]:
        """The messages of the closed recording: topic, payload, type."""
        messages = open_objective(self.path).messages()
        return [(message.topic, message.payload, message.type.zenoh_encoding) for message in messages]


@pytest.fixture
def making(session: zenoh.Session, tmp_path: Path) -> Making:
    return Making(session, tmp_path)
