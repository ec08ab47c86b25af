"""`aira demo`: one job, end to end, in one process."""

from __future__ import annotations

from pathlib import Path

import click

from mesh.cli.options import FOLDER, PATH, PORT
from mesh.dev.page import PAGE_PORT
from mesh.role.running import INTERRUPTED, run_to_end


@click.command("demo")
@click.option("--objective", type=PATH, help="MCAP file or ROS 1 bag to play [three blinks]")
@click.option(
    "--generation", type=click.Choice(["3", "5"]), default="3", help="generation of the messages and contracts [3]"
)
@click.option("--out", type=FOLDER, help="folder in which to keep the objective and the recording")
@click.option("--web", is_flag=True, help="serve the page of the market, and leave it open on the finished job")
@click.option("--web-port", type=PORT, help=f"port of the page [{PAGE_PORT}, or a free one if it is taken]")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object per line; the last one is a summary")
def command(
    objective: Path | None, generation: str, out: Path | None, web: bool, web_port: int | None, as_json: bool
) -> None:
    """Run one whole job: a person's demand and a robot's offer match, a contract holds the cost, the robot plays the
    objective to its device, records it and signs the result, and the contract pays. Everything is real and local:
    Zenoh sessions, an EVM, signatures, files.

    With --web the market stays open: the page shows the job, and orders more of the robot. Ctrl-C ends everything."""
    from tempfile import TemporaryDirectory

    from mesh.base.extras import needs_extra

    with needs_extra("demo", "the demo"):
        from mesh.dev.demo import Demo, JsonNarrator, TextNarrator
        from mesh.dev.page import page_server

    page = page_server(web_port) if web else None  # what is missing is said before anything is done
    narrator = JsonNarrator() if as_json else TextNarrator()
    with TemporaryDirectory(prefix="aira-demo-") as folder:
        demo = Demo(
            Path(folder), objective=objective, generation=int(generation), out=out, narrator=narrator, page=page
        )
        run_to_end(demo.run, interrupted=0 if web else INTERRUPTED)
