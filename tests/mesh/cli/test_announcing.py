"""The announcement of a server is one event, also when people see several lines."""

from __future__ import annotations

import json
import sys

import pytest

from tests.support.commands import run

PROGRAM = """
import logging
from mesh.cli.output import announce
from mesh.telemetry.logs import process_log, configure_logging
from schemas.status import ReadLogs
configure_logging(form={form!r}, role="up")
words = "router      tcp/here 100%\\nchain       http://there"
announce(logging.getLogger("a.server"), "server-started", words, chain="http://there", count=1)
print(process_log().buffer.read(ReadLogs()).entries[0].message)
"""
LINE = "router tcp/here 100%; chain http://there"


@pytest.mark.parametrize("form", ["human", "json"])
def test_json_logs_have_one_line_and_people_see_all_lines(form: str) -> None:
    done = run(sys.executable, "-c", PROGRAM.format(form=form))

    assert done.returncode == 0, done.stderr
    *said, kept = done.stdout.splitlines()
    assert kept == LINE
    if form == "human":
        assert (said, done.stderr) == (["router      tcp/here 100%", "chain       http://there"], "")
    else:
        event = json.loads(done.stderr)
        assert (said, event["event"], event["message"], event["chain"]) == ([], "server-started", LINE, "http://there")
        assert "count" not in event
