"""Plots of a recording: its numbers over time, and how many messages there are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mesh.cli.files import write_error
from mesh.extras import needs_extra
from mesh.recording import numbers_of

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from mesh.recording import Objective, Played, TopicRates

TOPICS: Final = 8
"""Topics whose numbers are drawn, each in axes of its own."""
FIELDS: Final = 12
"""Lines of a topic."""
POINTS: Final = 20_000
"""Points of a line; of more, every second is left out, again and again."""


class Line:
    """A number of a topic over time: seconds from the first message, and the values there."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.values: list[float] = []
        self._seen = 0
        self._every = 1

    def add(self, seconds: float, value: float) -> None:
        """Add the next point, unless it is one of those that are left out."""
        if self._seen % self._every == 0:
            self.seconds.append(seconds)
            self.values.append(value)
            if len(self.values) > POINTS:
                self.seconds, self.values, self._every = self.seconds[::2], self.values[::2], 2 * self._every
        self._seen += 1


def lines_of(messages: Iterable[Played], *, start_ns: int) -> dict[str, dict[str, Line]]:
    """The lines of each topic with numbers, by the names of their fields (empty for a number alone).

    Those beyond `TOPICS` and `FIELDS` are left out.
    """
    topics: dict[str, dict[str, Line]] = {}
    for message in messages:
        if message.topic not in topics and len(topics) == TOPICS:
            continue
        for name, number in numbers_of(message):
            lines = topics.setdefault(message.topic, {})
            if name in lines or len(lines) < FIELDS:
                lines.setdefault(name, Line()).add((message.log_time_ns - start_ns) / 1e9, number)
    return topics


def draw(objective: Objective, rates: TopicRates, path: Path) -> None:
    """Plot the numbers of each topic, and the messages per second of all, to a PNG at `path`.

    Raises `PackageMissing`, `FileUnwritable`.
    """
    with needs_extra("plot", "--png"):
        from matplotlib.figure import Figure
    topics = lines_of(objective.messages(), start_ns=objective.start_ns)
    figure = Figure(figsize=(10, 3 * (len(topics) + 1)), layout="constrained")
    all_axes = figure.subplots(len(topics) + 1, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (topic, lines) in zip(all_axes, topics.items(), strict=False):
        for name, line in lines.items():
            axes.plot(line.seconds, line.values, marker=".", label=_plain_text(name.lstrip(".")))
        axes.set(ylabel=_plain_text(topic))
        if any(lines):
            axes.legend(loc="upper right", fontsize="small")
    _draw_rates(all_axes[-1], rates)
    figure.suptitle(_plain_text(objective.path.name))
    try:
        figure.savefig(path, format="png", dpi=100)
    except OSError as error:
        raise write_error(path, error) from None


def _draw_rates(axes: Any, rates: TopicRates) -> None:
    spans = len(next(iter(rates.counts.values()), []))
    edges = [number * rates.span_ns / 1e9 for number in range(spans + 1)]
    for topic in sorted(rates.counts):
        axes.stairs(rates.per_second(topic), edges, label=_plain_text(topic))
    axes.set(xlabel="seconds from the first message", ylabel="messages per second")
    axes.set_ylim(bottom=0)
    if rates.counts:
        axes.legend(loc="upper right", fontsize="small")


def _plain_text(text: str) -> str:
    """Text from others for matplotlib, where a dollar starts a formula and a leading underscore hides a label."""
    shown = "".join(letter if letter.isprintable() else "\ufffd" for letter in text)
    return shown.replace("$", r"\$").lstrip("_")
