"""`python -m mesh` is the command line `aira`."""

from __future__ import annotations

from mesh.cli import main

if __name__ == "__main__":
    main(prog_name="aira")
