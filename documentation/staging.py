"""The pages that are written by hand, where the site has them, with links that fit there."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

ROOT: Final = Path(__file__).parents[1]
OUTSIDE: Final = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "contracts/README.md": "contracts.md",
}
"""Pages outside of docs/, each with its place in the site; besides these there are the READMEs of the examples."""
_FENCE: Final = re.compile(r"^```.*?^```|(?<=\n\n)(?: {4}[^\n]*\n)+", re.MULTILINE | re.DOTALL)
_LINK: Final = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\((?![a-z]+:)([^)#\s]+)(#[^)\s]*)?\)")


def places() -> dict[str, str]:
    """Every file that the site takes over, by its path in the repository: where the site has it."""
    found = {f"docs/{path.relative_to(ROOT / 'docs')}": str(path.relative_to(ROOT / "docs")) for path in _documents()}
    found |= OUTSIDE
    found |= {
        str(path.relative_to(ROOT)): f"examples/{path.parent.name}.md" for path in ROOT.glob("examples/*/README.md")
    }
    return dict(sorted(found.items()))


def stage(pages: Path, generated: Collection[str]) -> None:
    """Write the files of `places` into the folder `pages`. `generated` are further pages, which they may link to."""
    known = places()
    known |= {f"docs/{name}": name for name in generated}
    for source, place in places().items():
        target = pages / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.endswith(".md"):
            target.write_text(relinked((ROOT / source).read_text(encoding="utf-8"), source, known), encoding="utf-8")
        else:
            shutil.copy(ROOT / source, target)


def relinked(text: str, source: str, known: Mapping[str, str]) -> str:
    """A page's text with links to places in the site; a link to a file that the site lacks becomes its text.

    Links to files that do not exist stay, so that the builder of the site reports them.
    """
    here = os.path.dirname(known[source])

    def moved(link: re.Match[str]) -> str:
        said, path, anchor = link[1], link[2], link[3] or ""
        aim = os.path.normpath(os.path.join(os.path.dirname(source), path))
        aim = f"{aim}/README.md" if f"{aim}/README.md" in known else aim
        if aim in known:
            return f"[{said}]({os.path.relpath(known[aim], here or '.')}{anchor})"
        return said if (ROOT / aim).exists() else link[0]

    parts, end = [], 0
    for code in _FENCE.finditer(text):
        parts += [_LINK.sub(moved, text[end : code.start()]), code[0]]
        end = code.end()
    return "".join((*parts, _LINK.sub(moved, text[end:])))


def _documents() -> list[Path]:
    return [path for path in (ROOT / "docs").rglob("*") if path.is_file()]
