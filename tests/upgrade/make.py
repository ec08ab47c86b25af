"""Writes what this version keeps after a paid job, for the upgrade test of later versions.

    make upgrade-sample     # tests/upgrade/VERSION.tar.gz, by the version in pyproject.toml

It has the data folder of a market with a robot and a person, their keyfiles with the well-known keys of development and
their password, and a settings file with every option.
"""

from __future__ import annotations

import io
import os
import tarfile
import tempfile
from pathlib import Path
from typing import Final

from mesh import __version__
from tests.support.commands import AIRA, Serving, aira

HERE: Final = Path(__file__).parent
ROBOT: Final = """
from mesh import Agent, Job

robot = Agent()
robot.on_demand(lambda demand: robot.offer(demand))
robot.on("/blink")(lambda job, message: job.publish("/light", True))
robot.run()
"""


def make(folder: Path) -> None:
    """Let a robot do a job in a market whose files are below `folder`, and write the settings there."""
    program, words, data = folder / "robot.py", folder / "words", folder / "data"
    program.write_text(ROBOT)
    words.write_text('{"topic": "/blink", "value": 1}\n')
    objective, model = folder / "blink.mcap", "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"
    options = ("--engine", "embedded", "--port", "0", "--listen", "tcp/127.0.0.1:0", "--no-web", "--data-dir", data)
    with Serving(*AIRA, "up", *options, "--run", program, says="robot | ") as up:
        exports = (line.removeprefix("export ") for line in up.log().splitlines() if line.startswith("export "))
        variables = dict(line.split("=", 1) for line in exports)
        for command in (
            ("objective", "pack", words, "--out", objective),
            ("demand", "--cost", "1 XRT", "--model", model, "--objective", objective, "--data-dir", data),
        ):
            done = aira(*command, **variables)
            assert done.returncode == 0, done.stdout + done.stderr
    (folder / "aira.toml").write_text(aira("settings").stdout)


def pack(folder: Path, target: Path) -> None:
    """Pack the data folder and the settings."""
    with tarfile.open(target, "w:gz") as archive:
        for path in (folder / "aira.toml", *sorted((folder / "data").rglob("*"))):
            if path.is_file():
                entry = archive.gettarinfo(path, str(path.relative_to(folder)))
                entry.uid = entry.gid = 0
                entry.uname = entry.gname = ""
                archive.addfile(entry, io.BytesIO(path.read_bytes()))


def main() -> None:
    os.umask(0o077)
    with tempfile.TemporaryDirectory(prefix="aira-upgrade-") as name:
        make(Path(name))
        target = HERE / f"{__version__}.tar.gz"
        pack(Path(name), target)
    print(f"{target.relative_to(HERE.parents[1])} ({target.stat().st_size:,} bytes): commit it")


if __name__ == "__main__":
    main()
