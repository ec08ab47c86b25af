"""`python -m peers.where NAME`: print where a peer is, for shell scripts; exit with 1 and say why where it is not."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from peers.catalog import PEERS, PeerMissing, locate

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(arguments: Sequence[str]) -> int:
    """Print the path of the one peer that `arguments` name, and return the exit code."""
    try:
        (name,) = arguments
        print(locate(name))
    except ValueError:
        print("one name is needed: python -m peers.where NAME", file=sys.stderr)
    except KeyError:
        print(f"{name}: there is no such peer; there are {', '.join(PEERS)}", file=sys.stderr)
    except PeerMissing as missing:
        print(missing, file=sys.stderr)
    else:
        return 0
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
