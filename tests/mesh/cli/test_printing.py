"""The output of commands: columns, and JSON without loss."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from mesh.cli.output import plural, print_facts, print_json, print_table, printable


def test_facts_are_printed_in_two_columns_without_unknown_ones(capsys: pytest.CaptureFixture[str]) -> None:
    print_facts({"block": 5, "base fee": "1 gwei", "account": None})
    assert capsys.readouterr().out == "block     5\nbase fee  1 gwei\n"


def test_no_facts_print_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    print_facts({"account": None})
    assert capsys.readouterr().out == ""


def test_a_table_is_as_wide_as_its_cells_and_numbers_are_right_aligned(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("NAME", "STAKE"), [("airalab", "1 XRT"), ("b", "1,000 XRT")], numbers=("STAKE",))
    assert capsys.readouterr().out == "NAME         STAKE\nairalab      1 XRT\nb        1,000 XRT\n"


def test_numbers_that_doubles_can_not_represent_are_strings_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"small": 2**53 - 1, "large": 2**53, "deep": [{"larger": 2**256}], "yes": True})
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"small": 2**53 - 1, "large": str(2**53), "deep": [{"larger": str(2**256)}], "yes": True}


def test_control_characters_of_untrusted_text_are_replaced() -> None:
    assert printable("anvil\x1b[2J\u202e") == "anvil\N{REPLACEMENT CHARACTER}[2J\N{REPLACEMENT CHARACTER}"


@pytest.mark.parametrize(("count", "words"), [(0, "0 blocks"), (1, "1 block"), (2_000, "2,000 blocks")])
def test_a_noun_is_plural_unless_the_count_is_one(count: int, words: str) -> None:
    assert plural(count, "block") == words


def test_a_full_disk_is_one_clear_line() -> None:
    program = "from mesh.cli.output import print_json, print_line\nprint_line('a line')\nprint_json({'an': 'object'})\n"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "No space left on device" in line
    assert line.endswith("[output-failed]")
