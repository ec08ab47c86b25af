"""The site of the documentation: what its checks find, where links lead, and that nothing of the source is missing."""

from __future__ import annotations

import ast
import json
import re
from typing import TYPE_CHECKING

import click
import pytest

from documentation.checks import problems
from documentation.navigation import navigation
from documentation.performance import BARS, constants, performance
from documentation.pictures import screenshot
from documentation.reference import reference
from documentation.staging import ROOT, places, relinked
from mesh.cli import main
from mesh.settings import OPTIONS
from schemas import keys
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "guide.html").write_text('<h1 id="top">Guide</h1>')
    (tmp_path / "index.html").write_text(
        '<link rel="stylesheet" href="style.css"><a href="guide.html#top">a guide</a> <a href="https://example.org">x</a>'
    )
    (tmp_path / "style.css").write_text("p { background: url(data:image/png;base64,AAAA) }")
    return tmp_path


def test_a_site_that_is_complete_has_no_problem(site: Path) -> None:
    assert problems(site) == []


@pytest.mark.parametrize(
    ("added", "problem"),
    [
        ('<a href="gone.html">x</a>', "links to gone.html, which does not exist"),
        ('<a href="guide.html#end">x</a>', "links to guide.html#end, which guide.html has no anchor for"),
        ('<img src="gone.png">', "links to gone.png, which does not exist"),
        ('<a href="../outside.html">x</a>', "links to ../outside.html, which does not exist"),
        ('<script src="https://cdn.example/x.js"></script>', "loads https://cdn.example/x.js from another host"),
        ('<img src="//cdn.example/x.png">', "loads //cdn.example/x.png from another host"),
        ('<link rel="preconnect" href="https://fonts.example">', "loads https://fonts.example from another host"),
        ("<style>@import 'https://fonts.example/a.css'</style>", "loads https://fonts.example/a.css from another host"),
        (
            '<pre class="mermaid">a</pre>',
            "has an element of class 'mermaid', whose script is on another host",
        ),
    ],
)
def test_what_is_wrong_on_a_page_is_named(site: Path, added: str, problem: str) -> None:
    with (site / "index.html").open("a") as page:
        page.write(added)
    assert problems(site) == [f"index.html: {problem}"]


def test_a_style_that_loads_a_font_from_another_host_is_named(site: Path) -> None:
    (site / "style.css").write_text("@font-face { src: url('https://fonts.example/a.woff2') }")
    assert problems(site) == ["style.css: loads https://fonts.example/a.woff2 from another host"]


def test_links_out_of_the_folder_lead_to_where_the_site_has_these_pages() -> None:
    text = (
        "[a](../../README.md#install) [b](../../examples/rover) [`c`](../../mesh/errors.py) [d](sites.md)\n\n"
        "    [code](../../README.md)\n"
    )
    assert relinked(text, "docs/guides/agents.md", places()) == (
        "[a](../readme.md#install) [b](../examples/rover.md) `c` [d](sites.md)\n\n    [code](../../README.md)\n"
    )


def test_pages_come_in_the_order_in_which_the_first_one_links_to_them(tmp_path: Path) -> None:
    (tmp_path / "guides").mkdir()
    for name in ("a", "b", "c", "d"):
        (tmp_path / f"guides/{name}.md").write_text(f"# {name}")
    (tmp_path / "guides/index.md").write_text("[c](c.md#part)")
    (tmp_path / "index.md").write_text("[d](guides/d.md)")
    order = ["index", "d", "c", "a", "b"]
    assert f'{{"Guides" = {json.dumps([f"guides/{name}.md" for name in order])}}}' in navigation(tmp_path)


def test_every_command_is_described_with_its_options() -> None:
    pages = reference()
    context = click.Context(main, info_name="aira")
    for name in main.list_commands(context):
        page = pages[f"reference/commands/{name}.md"]
        assert [line for line in described(main.get_command(context, name), f"aira {name}") if line not in page] == []


def described(command: click.Command | None, path: str) -> list[str]:
    assert command is not None
    context = click.Context(command, info_name=path)
    own = [one.opts[0] for one in command.params if isinstance(one, click.Option) and not one.hidden]
    below = command.list_commands(context) if isinstance(command, click.Group) else []
    inner = [line for name in below for line in described(command.get_command(context, name), f"{path} {name}")]  # type: ignore[attr-defined]
    return [f"# {path}\n", *own, *inner]


def test_every_setting_has_an_anchor() -> None:
    text = reference()["reference/settings.md"]
    assert [name for name in OPTIONS if f"{{ #{name} }}" not in text] == []


def test_every_key_is_listed() -> None:
    text = reference()["reference/keyspace.md"]
    kinds = [kind for kind in vars(keys).values() if isinstance(kind, type) and issubclass(kind, keys.BaseKey)]
    patterns = [kind.pattern for kind in kinds if hasattr(kind, "pattern")]
    assert len(patterns) > 20
    assert [pattern for pattern in patterns if f"<code>{pattern.replace('/', '/<wbr>')}</code>" not in text] == []


def test_performance_is_what_was_measured_with_the_bars_of_the_benchmarks() -> None:
    text = performance()
    results = decode_json((ROOT / "bench" / "results.json").read_bytes())
    assert [name for name in results if not (ROOT / "bench" / f"{name}.py").is_file()] == []
    assert len(re.findall(r"^\d{4}-\d\d-\d\d, commit `\w+", text, re.MULTILINE)) == len(results)
    figures = results["messages"]["measured"]
    assert f"| verified per second | {figures['verified_per_second']:,} |  |" in text
    assert f"| ratio | {figures['ratio']} | at least 0.7 |" in text


def test_every_bar_is_a_number_of_its_benchmark() -> None:
    for name, bars in BARS.items():
        known = constants(ast.parse((ROOT / "bench" / f"{name}.py").read_text()))
        assert [bar for bar in bars.values() if re.split(r"[: \[]+", bar)[2] not in known] == []


def test_every_picture_is_a_screenshot_of_a_test() -> None:
    tests = "".join(path.read_text() for path in sorted((ROOT / "tests" / "web").glob("test_*.py")))
    made = ('"{}": ', "{}-{{look(", 'pictures, "{}"')
    assert [page for page in pages_in_pictures() if not any(form.format(page) in tests for form in made)] == []


def pages_in_pictures() -> set[str]:
    """What the screenshots of all pictures are of: a file's name, or that of a page in several sizes."""
    pictures = [path.name for path in (ROOT / "docs" / "pictures").iterdir()]
    files = {screenshot(name) for name in pictures if not name.startswith("first-")}  # tests/test_tutorials.py
    return {re.sub(r"-(phone|desktop)-(light|dark)\.png$", "", name) for name in files}
