"""Layouts for Foxglove: JSON files to import there."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any


def layout_json(name: str, *, plots: tuple[str, ...] = (), images: tuple[str, ...] = ()) -> str:
    """The layout of that name, with these paths in its plot, and a panel for each of these topics of images."""
    layout: dict[str, Any] = json.loads(files(__name__).joinpath(f"{name}.json").read_text())
    panels = layout["configById"]
    if plots:
        series = [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in plots]
        panels["Plot!values"]["paths"] = series
    for number, topic in enumerate(images):
        panel = f"Image!{number}"
        panels[panel] = {"imageMode": {"imageTopic": topic}}
        layout["layout"] = {"direction": "row", "first": layout["layout"], "second": panel, "splitPercentage": 70}
    return json.dumps(layout, indent=2)
