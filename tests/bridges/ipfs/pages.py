"""What a bridge serves over HTTP about itself."""

from __future__ import annotations

import json
import urllib.error
import urllib.request

SECONDS = 60.0


def health(port: int) -> tuple[int, dict[str, str]]:
    """What `/health` answers: its code, and the parts."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=SECONDS) as answer:
            return answer.status, json.load(answer)["parts"]
    except urllib.error.HTTPError as answer:
        return answer.code, json.load(answer)["parts"]


def metrics(port: int) -> str:
    """The page of metrics."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=SECONDS) as answer:
        text: str = answer.read().decode()
        return text
