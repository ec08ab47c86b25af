"""From ROS 1 bags to MCAP, without losing anything."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.recording.limits import Limits
from mesh.recording.mcap_file import McapFile, written_durably
from mesh.recording.objective import open_source
from mesh.recording.recovery import copy_content

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Progress

_DEFAULT: Final = Limits()


def bag_to_mcap(
    bag: Path, target: Path, *, cid: str = "", limits: Limits = _DEFAULT, progress: Progress | None = None
) -> Path:
    """Write the messages of a ROS 1 bag to an MCAP file of the profile `ros1`, and return where that is.

    Payloads and definitions stay the bytes they are, in the order of the bag; what a connection says besides (md5sum,
    callerid, latching) is its channel's metadata. `cid`, the bag's own name, goes into the metadata record `aira` as
    `source`. Replaces what is at `target`, atomically. `progress` is told how many messages are written, of how many.
    Blocks on the disk. Raises what `open_objective` does.
    """
    source = open_source(bag, limits)
    with written_durably(target) as stream:
        file = McapFile(stream, profile="ros1")
        file.add_metadata("aira", {"source": cid, "source_format": source.format})
        copy_content(source, file, progress=progress)
        file.finish()
    return target
