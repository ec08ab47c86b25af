from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

from tests.support.peers import require

if TYPE_CHECKING:
    from pathlib import Path

PNG = b"\x89PNG\r\n\x1a\n"


def test_chromium_renders_a_page_to_png(tmp_path: Path) -> None:
    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text("<!doctype html><title>mesh</title><body style='background: teal'><h1>rendered</h1>")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    shot = [f"--screenshot={picture}", "--window-size=400,300", page.as_uri()]
    subprocess.run([require("chromium"), *options, *shot], capture_output=True, timeout=120, check=True)
    assert picture.read_bytes().startswith(PNG)
    width_and_height = picture.read_bytes()[16:24]
    assert width_and_height == (400).to_bytes(4, "big") + (300).to_bytes(4, "big")


def test_chromedriver_is_of_the_same_release_as_chromium() -> None:
    versions = [version_of(require(name)) for name in ("chromium", "chromedriver")]
    assert versions[0] == versions[1]


def version_of(program: Path) -> str:
    done = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=60, check=True)
    return next(word for word in done.stdout.split() if word[0].isdigit())
