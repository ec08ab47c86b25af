"""`aira completion`: a real bash completes with what it prints."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.commands import aira, environment

COMPLETE = """
eval "$(aira completion bash)"
COMP_WORDS=({words}); COMP_CWORD={at}
_aira_completion aira
echo "${{COMPREPLY[@]}}"
"""


@pytest.mark.parametrize(("words", "found"), [(("aira", "ord"), "order"), (("aira", "order", "w"), "withdraw")])
def test_bash_completes_commands(words: tuple[str, ...], found: str) -> None:
    script = COMPLETE.format(words=" ".join(words), at=len(words) - 1)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script], env=environment({"PATH": path}), capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.split() == [found], done.stderr


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_have_a_script(shell: str) -> None:
    done = aira("completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    assert "_AIRA_COMPLETE" in done.stdout
