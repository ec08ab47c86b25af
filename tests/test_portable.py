"""What only Linux has is not needed to import a module, nor for files and pages."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.support.commands import environment

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "mesh", "bridges")

PROGRAM = """
import os, socket, sys
from importlib import import_module

import a2a, aiohttp, mcp, serial, uvicorn, web3  # what they import is theirs

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "resource"):
            raise ModuleNotFoundError(f"there is no {name} here", name=name)

for name in ("fcntl", "resource"):
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hidden())
for module, name in ((os, "posix_fadvise"), (os, "sched_getaffinity"), (socket, "TCP_INFO")):
    delattr(module, name)

def hide(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and str(arguments[0]).startswith("/proc"):
        raise FileNotFoundError(2, "there is no /proc here", arguments[0])

sys.addaudithook(hide)
"""


def run(program: str, *arguments: str | Path) -> None:
    """Run a program without what only Linux has; it must succeed."""
    command = [sys.executable, "-c", PROGRAM + program, *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, env=environment({}), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_module_is_imported_without_what_only_linux_has() -> None:
    paths = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths}
    run("for name in sys.argv[1:]: import_module(name)", *sorted(names - {"mesh.__main__"}))
