"""The examples with a board, run as in their READMEs: every role in its own process."""

from __future__ import annotations

import re
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.support.boards import board, edge
from tests.support.commands import AIRA, Serving
from tests.support.ports import free_port
from tests.support.recordings import check_recording, recordings_in

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bridges.serial.boards import SimulatedBoard

EXAMPLES = Path(__file__).parents[2] / "examples"
PROTOCOLS = ("frames", "rosserial")


@pytest.fixture(scope="module")
def market(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Router, chain and provider of a module; returns the environment variables of the other processes, without the
    keyfile.

    At the end, other programs must be able to read all that was recorded.
    """
    folder = tmp_path_factory.mktemp("market")
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    up = ("up", "--data-dir", folder, "--listen", endpoint, "--port", str(port))
    with Serving(*AIRA, *up, says="provider    0x"):
        yield {
            "AIRA_CONNECT": endpoint,
            "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{port}",
            "AIRA_DATA_DIR": str(folder),
            "AIRA_KEYFILE_PASSWORD_FILE": str(folder / "development" / "password"),
        }
    for path in recordings_in(folder):
        check_recording(path)


def as_role(role: str, market: dict[str, str]) -> dict[str, str]:
    """The environment variables of a process with this role's account."""
    return market | {"AIRA_KEYFILE": f"{market['AIRA_DATA_DIR']}/development/{role}.json"}


@contextmanager
def at_work(example: str, sketch: str, protocol: str, market: dict[str, str]) -> Iterator[SimulatedBoard]:
    """The robot of an example with its board and its edge agent, running."""
    script, variables = EXAMPLES / example / "robot.py", as_role("robot", market)
    with ExitStack() as stack:
        uno = stack.enter_context(board(f"examples/{example}/{sketch}_{protocol}"))
        robot = stack.enter_context(Serving(sys.executable, script, says="account 0x", variables=variables))
        found = re.search(r"account (0x\w{40})", robot.log())
        assert found
        stack.enter_context(edge(uno.port, found[1], market["AIRA_CONNECT"], "--protocol", protocol))
        yield uno
