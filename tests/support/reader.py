"""Somebody who types the commands of a document, each block into a shell of its own."""

from __future__ import annotations

import re
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tests.support.blocks import blocks as blocks_of
from tests.support.commands import Serving, run
from tests.support.ports import free_port

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator, Sequence

COMMAND: Final = re.compile(r"(?:\w+=\S+ )*(?:aira|cd|echo|eval|export|make|npm|pip|pipx|pytest|python|sed|sh|uv)\s")
PORT: Final = "/tmp/aira-board-…/tty"
"""What readers replace by the port that `aira board run` has printed."""
ROBOT: Final = "account 0x70997970C51812dc3A010C7d01b50e0d17dc79C8"

SERVES: Final = {
    "aira up --run": ROBOT,
    "aira up": "export AIRA_KEYFILE_PASSWORD_FILE",
    "aira chain up": "password    ",
    "aira provider": "0xf39Fd6e51aad88F6F4ce6aB8827279cffFb92266",
    "aira router": "listens at",
    "aira board run": "connect it with",
    "aira edge": "edge of 0x",
    "hello_mesh/agent.py": "watching on",
    "/forklift.py": "account 0x",
    "/robot.py": "account 0x",
    "/lamp.py": ROBOT,
    "/rover.py": "the rover drives",
}
"""Commands that serve until they are stopped, each with what it prints when it is ready."""
VARIES: Final = re.compile(r"0x[0-9a-fA-F]+|Qm\w{44}|\b[0-9a-f]{64}\b|\d[\d,.]*")
"""What commands print, and is another each time."""
NOT_RUN: Final = {
    "aira chain deploy": "it is for other chains than that of `aira up`, which has the contracts",
    "make test": "it runs this test",
    "pipx install": "it installs from a registry; the tests of the wheel install the package",
}
ENDS: Final = {
    "aira demand": "paid, result Qm",
    "person.py": "hydrogen",
    "client.py": "Alice was paid",
    "objective show": "/patrol/goal",
    "plot.py": "measurements",
    "completion": "",
    "model check": "the objective fits",
    "pytest": "2 passed",
    "aira status": "alive",
    "objective pack": "",
}
"""What commands print that have done their work."""


def blocks(readme: Path) -> list[str]:
    """The commands of a README, one text for each of its blocks."""
    found = re.findall(r"(?:^    .*\n|^\n(?=    ))+", readme.read_text(encoding="utf-8"), re.MULTILINE)
    return [
        block
        for text in found
        for block in re.split(r"\n\n+", re.sub(r"^    ", "", text, flags=re.MULTILINE).strip("\n"))
        if COMMAND.match(block)
    ]


def lines_of(text: str) -> list[str]:
    """The lines of an output, as they are each time; lines about progress, which are alike then, once."""
    lines = [VARIES.sub("…", " ".join(line.split())) for line in text.splitlines() if line.strip()]
    lines = [line for line in lines if not line.startswith("$ ")]  # on a page, what was typed
    return [line for line, before in zip(lines, ["", *lines], strict=False) if line != before]


def blocks_printed(page: Path, printed: str) -> int:
    """How many blocks of a page show what a command has printed: their first line is in it, and so must be the rest."""
    output, found = lines_of(printed), 0
    for block in blocks_of(page):
        shown = lines_of(block.text)
        if shown and shown[0] in output:
            at = output.index(shown[0])
            assert output[at : at + len(shown)] == shown, f"{page.name}:{block.line}"
            found += 1
    return found


@dataclass
class Reader:
    """Types commands in a folder. The ports are its own, by variables; chains have none, so these get options."""

    folder: Path
    variables: dict[str, str]
    chain: int
    stack: ExitStack
    port: str = PORT
    page: str = "--no-web"
    """What `aira up` is told about the page."""
    market: str = ""
    """What `aira up` has printed until it was ready."""

    def follow(self, commands: Sequence[str]) -> list[str]:
        """Run all blocks; what those printed that end."""
        return [printed for block in commands for printed in self.type(block)]

    def type(self, block: str) -> Iterator[str]:
        """Run the commands of a block, but for those that can't be run here."""
        lines = block.replace("\\\n", "").replace(PORT, self.port).splitlines()
        lines = [line for line in lines if not any(line.startswith(command) for command in NOT_RUN)]
        if not lines:
            return
        says = next((says for part, says in SERVES.items() if part in lines[-1]), None)
        if says is None:
            done = self._run("\n".join(lines))
            assert done.returncode == 0, f"{block}\n{done.stdout}{done.stderr}"
            for command, printed in ENDS.items():
                assert command not in block or printed in done.stdout, f"{block}\n{done.stdout}{done.stderr}"
            yield done.stdout
            return
        if lines[-1].startswith("aira up"):
            lines[-1] += f" --engine embedded --port {self.chain} {self.page}"
        elif lines[-1].startswith("aira chain up"):
            lines[-1] += f" --engine embedded --port {self.chain}"
        lines[-1] = re.sub(r"^((?:\w+=\S+ )*)", r"\1exec ", lines[-1])  # so that it is the process that is stopped
        server = self.stack.enter_context(Serving(*self._shell("\n".join(lines)), says=says))
        if lines[-1].startswith("exec aira up"):
            self.market = server.log()
        if found := re.search(r"connect it with: aira edge (\S+)", server.log()):
            self.port = found[1]

    def refused(self, block: str) -> str:
        """Run commands of which the last one fails; what it says. Nothing if it has not failed."""
        done = self._run(block)
        return done.stderr if done.returncode else ""

    def _run(self, script: str) -> subprocess.CompletedProcess[str]:
        return run(*self._shell(script))

    def _shell(self, script: str) -> tuple[str, ...]:
        variables = (f"{name}={value}" for name, value in self.variables.items())
        return ("env", "-i", *variables, "bash", "-euo", "pipefail", "-c", f"cd {self.folder}\n{script}")


@contextmanager
def reading(folder: Path) -> Iterator[Reader]:
    """Somebody who has nothing but a PATH and this folder, in which there is also a home. Stops what was started."""
    home, temporary = folder.parent / "home", folder.parent / "t"
    for each in (folder, home, temporary):
        each.mkdir(exist_ok=True)
    router, chain, ros = (free_port() for _ in range(3))
    variables = {
        "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
        "HOME": str(home),
        "TMPDIR": str(temporary),
        "AIRA_LISTEN": f"tcp/127.0.0.1:{router}",
        "AIRA_CONNECT": f"tcp/127.0.0.1:{router}",
        "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{chain}",
        "ROS2_CONNECT": f"tcp/127.0.0.1:{ros}",
    }
    with ExitStack() as stack:
        yield Reader(folder, variables, chain, stack)
