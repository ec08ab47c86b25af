"""Texts of the source as Markdown."""

from __future__ import annotations

import html
import re
from inspect import cleandoc
from typing import Final

_MARKUP: Final = re.compile(r"[\\*_\[\]|#]")


def escaped(text: str) -> str:
    """A text in which only backticks are markup."""
    words = text.split("`")
    words[::2] = [html.escape(_MARKUP.sub(r"\\\g<0>", word), quote=False) for word in words[::2]]
    return "`".join(words)


def paragraphs(text: str) -> str:
    """A help text; what click must not wrap becomes a block."""
    parts = [cleandoc(part) for part in re.split(r"\n[ \t]*\n", cleandoc(text)) if part.strip()]
    return "\n\n".join(_block(part) if part.startswith("\b") else escaped(part) for part in parts) + "\n"


def _block(part: str) -> str:
    return f"```text\n{cleandoc(part.removeprefix(chr(8))).strip(chr(10))}\n```"
