"""`aira`, also as `python -m mesh`: the command line, which Ctrl-C ends quietly even while it is being loaded.

Terminals may lack characters, such as those of Latin-1, KOI8-R or ASCII: these show others instead.
"""

from __future__ import annotations

import codecs
import os
import signal
import sys
from io import TextIOWrapper
from typing import TYPE_CHECKING, Final, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

PLAIN: Final = {
    **dict(zip("…→·●○", ("...", "->", "*", "*", "o"), strict=True)),
    **dict(zip("▁▂▃▄▅▆▇█", "_.-:=+*#", strict=True)),
    "\u2013": "-",
    "\u2019": "'",
}
"""Characters of our own texts, and usual ones of others, in ASCII. `\\N{…}` would load Unicode's tables."""
ASCII: Final = "aira_ascii"
"""The encoding ASCII under another name: click writes UTF-8 to a terminal whose encoding has the name ASCII."""


def main() -> None:
    """Load the command line and run it."""
    # Until the command listens to signals itself there is nothing to tidy up, but an interrupted import may print a
    # traceback, swallow the interrupt, or make Python exit with another code.
    signal.signal(signal.SIGINT, _leave)
    from mesh.cli import main as command_line

    accept_all_characters()
    command_line(prog_name="aira")


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    os._exit(130)  # `mesh.role.running.INTERRUPTED`, which may not be loaded yet


def accept_all_characters() -> None:
    """Let stdout and stderr of this process take every text: what their encoding lacks is replaced.

    Otherwise a single such character would end a command with `UnicodeEncodeError`. Also file names that are not valid
    in the locale can be printed.
    """
    codecs.register(_ascii)
    for stream, otherwise in ((sys.stdout, "replace"), (sys.stderr, "backslashreplace")):
        name = f"aira-{otherwise}"
        codecs.register_error(name, _plain_or(otherwise))
        if isinstance(stream, TextIOWrapper):  # not what an embedding program has put there
            is_ascii = codecs.lookup(stream.encoding).name == "ascii"
            stream.reconfigure(encoding=ASCII if is_ascii else stream.encoding, errors=name)


def _plain_or(otherwise: str) -> Callable[[UnicodeError], tuple[str | bytes, int]]:
    """An error handler that writes characters as in `PLAIN`, and others as the handler `otherwise` does."""
    other = codecs.lookup_error(otherwise)

    def replaced(error: UnicodeError) -> tuple[str | bytes, int]:
        if not isinstance(error, UnicodeEncodeError):
            return other(error)
        at = error.start
        plain = PLAIN.get(error.object[at])
        return (plain, at + 1) if plain else other(UnicodeEncodeError(error.encoding, error.object, at, at + 1, ""))

    return replaced


def _ascii(name: str) -> codecs.CodecInfo | None:
    if name != ASCII:
        return None
    own = codecs.lookup("ascii")
    return codecs.CodecInfo(
        own.encode,
        own.decode,
        streamreader=own.streamreader,
        streamwriter=own.streamwriter,
        incrementalencoder=own.incrementalencoder,
        incrementaldecoder=own.incrementaldecoder,
        name=ASCII,
    )


if __name__ == "__main__":
    main()
