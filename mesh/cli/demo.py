"""`aira demo`: one job, end to end, in one process."""

from __future__ import annotations

from pathlib import Path

import click

from mesh.running import run_to_end


@click.command("demo")
@click.option("--objective", type=click.Path(path_type=Path), help="MCAP file or ROS 1 bag to play [three blinks]")
@click.option(
    "--generation", type=click.Choice(["3", "5"]), default="3", help="generation of the messages and contracts [3]"
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="folder in which to keep the objective and the recording",
)
@click.option("--json", "as_json", is_flag=True, help="print one JSON object per line; the last one is a summary")
def command(objective: Path | None, generation: str, out: Path | None, as_json: bool) -> None:
    """Run one whole job: a person's demand and a robot's offer match, a contract holds the cost, the robot plays the
    objective to its device, records it and signs the result, and the contract pays. Everything is real and local:
    Zenoh sessions, an EVM, signatures, files."""
    from tempfile import TemporaryDirectory

    from mesh.extras import needs_extra

    with needs_extra("demo", "the demo"):
        from mesh.demo.demo import Demo
    from mesh.demo.narration import JsonNarrator, TextNarrator

    narrator = JsonNarrator() if as_json else TextNarrator()
    with TemporaryDirectory(prefix="aira-demo-") as folder:
        demo = Demo(Path(folder), objective=objective, generation=int(generation), out=out, narrator=narrator)
        run_to_end(demo.run)
