"""Drawing to a file, where matplotlib is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.cli.files import unwritable
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording import TopicRates


def draw(rates: TopicRates, path: Path, *, title: str) -> None:
    """Draw the messages a second of each topic over time, to a PNG at `path`.

    Raises `ConfigurationError` where matplotlib is missing or the file can't be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigurationError(
            "drawing needs matplotlib, which is not installed", hint="pip install 'aira-mesh[plot]'"
        ) from None
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.add_subplot()
    spans = len(next(iter(rates.counts.values()), []))
    edges = [number * rates.span_ns / 1e9 for number in range(spans + 1)]
    for topic in sorted(rates.counts):
        axes.stairs(rates.per_second(topic), edges, label=_plain(topic))
    axes.set(title=_plain(title), xlabel="seconds from the first message", ylabel="messages a second")
    axes.set_ylim(bottom=0)
    if rates.counts:
        axes.legend(loc="upper right", fontsize="small")
    try:
        figure.savefig(path, format="png", dpi=100)
    except OSError as error:
        raise unwritable(path, error) from None


def _plain(text: str) -> str:
    """A stranger's text as text: a dollar begins a formula, a leading underscore hides a label."""
    shown = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    return shown.replace("$", r"\$").lstrip("_")
