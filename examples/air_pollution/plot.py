"""Plots measurements of the air pollution sensor from recordings: `python plot.py RECORDING… -o air.png`."""

import argparse
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from mesh import AiraError, ConfigurationError, InputError, String, fail, open_objective

GASES = ("dust", "CO", "LPG", "methane", "smoke", "hydrogen")

Reading = tuple[datetime, list[float]]
"""When it was recorded, and the voltages in the order of `GASES`."""


def readings(recording: Path) -> Iterator[Reading]:
    """The measurements in a recording. Raises `InputError` for a message that is not a measurement."""
    for message in open_objective(recording).messages():
        if message.topic == "/measurements":
            words = String.decode(message.payload).data.split()
            try:
                volts = [float(word) for word in words]
            except ValueError:
                volts = []
            if len(volts) != len(GASES):
                raise InputError(f"{recording}: {' '.join(words)!r} is no measurement: {len(GASES)} numbers are one")
            yield datetime.fromtimestamp(message.log_time_ns / 1e9, UTC), volts


def draw(measured: Iterable[Reading], png: Path) -> int:
    """Plot them to `png`, one line per gas; returns how many there are. Raises `ConfigurationError`, `InputError`."""
    try:
        from matplotlib.dates import date2num
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigurationError(
            "drawing needs matplotlib", hint="in a clone of aira-mesh: pip install '.[plot]'"
        ) from None
    ordered = sorted(measured)
    if not ordered:
        raise InputError("there are no measurements to draw", hint="a recording of /measurements has them")
    days = [date2num(when) for when, _ in ordered]  # type: ignore[no-untyped-call]
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.add_subplot()
    for number, gas in enumerate(GASES):
        axes.plot(days, [volts[number] for _, volts in ordered], marker=".", label=gas)
    axes.set(title="Air pollution", xlabel="time (UTC)", ylabel="volts")
    axes.xaxis_date("UTC")
    axes.set_ylim(0, 5)
    axes.legend(loc="upper right", fontsize="small")
    try:
        figure.savefig(png, format="png", dpi=100)
    except OSError as error:
        raise InputError(f"can't write {png}: {error.strerror}") from None
    return len(ordered)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Draw measurements of the air pollution sensor.")
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help="an MCAP file or a ROS 1 bag")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="PNG", help="picture to write")
    given = parser.parse_args()
    try:
        count = draw((each for recording in given.recordings for each in readings(recording)), given.out)
    except AiraError as error:
        fail(error)
    print(f"{given.out}: {count} measurements")


if __name__ == "__main__":
    main()
