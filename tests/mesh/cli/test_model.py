"""`aira model`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from schemas import cid_of_file
from schemas.model import InvalidDescription, ModelDescription, read_description
from tests.support.commands import aira, invoke, refused
from tests.support.objectives import objective

if TYPE_CHECKING:
    import subprocess

ROOT = Path(__file__).parents[3]
EXAMPLES = ROOT / "examples"
DRAFT: dict[str, Any] = {
    "title": "Lamp",
    "description": "A lamp that blinks.",
    "objective": [
        {"topic": "/blink", "required": True, "value": {"type": "string", "enum": ["red", "blue"], "default": "red"}},
        {
            "topic": "/drive",
            "maxMessages": 2,
            "value": {
                "type": "object",
                "properties": {"speed": {"type": "number", "title": "Speed", "unit": "m/s", "maximum": 2.0}},
            },
        },
    ],
    "result": [{"topic": "/led"}],
    "success": "The lamp has blinked.",
    "price": "5 XRT",
    "limits": {"messages": 10},
}


def model(*words: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    return invoke("model", *words, AIRA_DATA_DIR=str(folder / "data"))


@pytest.fixture
def draft(tmp_path: Path) -> Path:
    path = tmp_path / "draft.json"
    path.write_text(json.dumps(DRAFT))
    return path


@pytest.fixture
def described(draft: Path) -> Path:
    assert model("new", draft, folder=draft.parent).returncode == 0
    return draft.with_name("model.json")


def test_new_writes_the_only_form_and_prints_the_model(draft: Path) -> None:
    done = model("new", draft, "--json", folder=draft.parent)
    path = draft.with_name("model.json")
    assert json.loads(done.stdout) == {"cid": cid_of_file(path), "file": str(path)}
    description = read_description(path.read_bytes())
    assert json.loads(msgspec.json.encode(description)) == {"format": "aira-model/1", **DRAFT}


def test_new_replaces_a_file_only_if_asked_or_if_it_is_the_source(draft: Path, described: Path) -> None:
    refused(model("new", draft, folder=draft.parent), "file-exists", described)
    described.write_text(json.dumps(DRAFT | {"title": "Other"}))
    assert model("new", described, folder=draft.parent).returncode == 0
    assert read_description(described.read_bytes()).title == "Other"
    assert model("new", draft, "--replace", folder=draft.parent).returncode == 0
    assert read_description(described.read_bytes()).title == "Lamp"


def test_new_refuses_what_is_wrong_and_writes_nothing(draft: Path) -> None:
    draft.write_text(json.dumps(DRAFT | {"price": "cheap"}))
    refused(model("new", draft, folder=draft.parent), InvalidDescription, "price", exit_code=2)
    assert not draft.with_name("model.json").exists()


@pytest.mark.parametrize(
    ("message", "exit_code", "reason"),
    [
        (("/blink", "red"), 0, ""),
        (("/blink", "green"), 1, "unfit-message"),
        (("/fly", "red"), 1, "unknown-topic"),
        (("/drive", {"speed": 1}), 1, "missing-topic"),
    ],
)
def test_check_finds_out_whether_an_objective_fits(
    described: Path, message: tuple[str, object], exit_code: int, reason: str
) -> None:
    path = described.with_name("objective.mcap")
    path.write_bytes(objective(message))
    done = model("check", described, path, "--json", folder=described.parent)
    facts = json.loads(done.stdout)
    assert (done.returncode, facts["ok"], facts["reason"]) == (exit_code, not reason, reason)
    assert facts["cid"] == cid_of_file(described)
    assert model("check", described, path, folder=described.parent).returncode == exit_code


def test_check_refuses_a_description_that_is_not_canonical(described: Path) -> None:
    described.write_bytes(described.read_bytes().rstrip())
    refused(model("check", described, folder=described.parent), InvalidDescription, "not-canonical", exit_code=2)


@pytest.mark.parametrize(("text", "reason"), [("{", "not-json"), (json.dumps(DRAFT), "not-canonical"), ("{}", "field")])
def test_check_refuses_a_json_file_that_is_no_description(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "lamp.json"
    path.write_text(text)
    refused(model("check", path, folder=tmp_path), InvalidDescription, reason, exit_code=2)


def test_a_text_is_a_model_without_a_description(tmp_path: Path) -> None:
    text = EXAMPLES / "blink" / "model.md"
    done = model("check", text, EXAMPLES / "blink" / "blink.mcap", "--json", folder=tmp_path)
    facts = {"cid": cid_of_file(text), "described": False, "ok": True, "reason": "", "detail": ""}
    assert json.loads(done.stdout) == facts
    assert json.loads(model("show", text, "--json", folder=tmp_path).stdout)["description"] is None
    assert model("show", text, folder=tmp_path).stdout == text.read_text()


def test_show_prints_the_description(described: Path) -> None:
    done = model("show", described, folder=described.parent)
    lines = [" ".join(line.split()) for line in done.stdout.splitlines()]
    assert f"model {cid_of_file(described)}" in lines
    assert "/blink red | blue, default red required" in lines
    assert "speed number, to 2 m/s Speed" in lines
    shown = json.loads(model("show", described, "--json", folder=described.parent).stdout)
    assert msgspec.convert(shown["description"], ModelDescription) == read_description(described.read_bytes())


def test_the_schema_in_the_docs_is_that_of_the_source(tmp_path: Path) -> None:
    documented = ROOT / "docs" / "reference" / "model.schema.json"
    assert model("schema", folder=tmp_path).stdout == documented.read_text(), (
        "aira model schema > docs/reference/model.schema.json"
    )


def test_the_description_in_the_docs_is_canonical() -> None:
    (block,) = re.findall(r"```json\n(.*?)```", (ROOT / "docs" / "reference" / "models.md").read_text(), re.DOTALL)
    assert read_description(block.encode()).title == "Blink with arguments"


PROGRAM = '''"""Drive: a robot on wheels."""

from msgspec import Struct

from helper import LIMIT
from mesh import Agent, Job

agent = Agent()


class Move(Struct):
    speed: float


@agent.on("/drive")
async def drive(job: Job, move: Move) -> None: ...


agent.run()
'''


def program(folder: Path, text: str) -> Path:
    path = folder / "robot.py"
    path.write_text(text)
    (folder / "helper.py").write_text("LIMIT = 5\n")
    return path


def new_model(source: Path) -> ModelDescription:
    done = model("new", source, "--replace", folder=source.parent)
    assert done.returncode == 0, done.stderr
    return read_description(source.with_name("model.json").read_bytes())


def test_new_describes_the_agent_of_a_program_without_running_it(tmp_path: Path) -> None:
    description = new_model(program(tmp_path, PROGRAM))
    assert (description.title, description.description) == ("Drive", "Drive: a robot on wheels.")
    (topic,) = description.objective
    assert topic.value is not None
    assert (topic.topic, topic.value.required) == ("/drive", ("speed",))


def test_a_title_ends_with_its_sentence(tmp_path: Path) -> None:
    source = program(
        tmp_path, PROGRAM.replace("Drive: a robot on wheels.", "Version 2.0 of `drive.py`. It has wheels.")
    )
    assert new_model(source).title == "Version 2.0 of `drive.py`"


def test_new_takes_the_description_that_a_program_has(tmp_path: Path) -> None:
    text = PROGRAM + 'MODEL = agent.model_description("Wheels", price="5 XRT")\n'
    description = new_model(program(tmp_path, text))
    assert (description.title, description.price, len(description.objective)) == ("Wheels", "5 XRT", 1)


def test_new_describes_an_agent_whose_model_is_the_file_to_write(tmp_path: Path) -> None:
    text = PROGRAM.replace("Agent()", 'Agent(Path(__file__).with_name("model.json"))')
    source = program(tmp_path, text.replace("from msgspec", "from pathlib import Path\n\nfrom msgspec"))
    first = new_model(source)
    assert new_model(source) == first


def test_new_describes_the_robot_of_the_docs(tmp_path: Path) -> None:
    (text,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "guides" / "describe-a-robot.md").read_text(), re.DOTALL
    )
    description = new_model(program(tmp_path, text))
    assert (description.title, description.price, description.seconds) == ("Rover", "5 XRT", 10)
    (topic,) = description.objective
    assert topic.value is not None
    assert topic.value.properties["speed"].unit == "m/s"


def test_new_starts_no_agent(tmp_path: Path) -> None:
    text = """
from mesh import Agent, run_to_end

agent = Agent()

async def main() -> None:
    async with agent:
        raise SystemExit("it was started")

run_to_end(main)
"""
    done = aira("model", "new", program(tmp_path, text))
    refused(done, "program-unusable", "robot.py starts its agent", exit_code=2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import helper\nraise RuntimeError('no\\nmotor')", "robot.py:2: RuntimeError: no motor"),
        ("import nothing_of_that_name", "ModuleNotFoundError"),
        ("def broken(", "SyntaxError"),
        ("import sys; sys.exit(3)", "SystemExit"),
        ("x = 1", "no agent"),
        ("from mesh import Agent; left = Agent(); right = Agent()", "left, right"),
    ],
)
def test_new_refuses_a_program_without_one_agent(tmp_path: Path, text: str, said: str) -> None:
    done = model("new", program(tmp_path, text), folder=tmp_path)
    refused(done, "program-unusable", said, exit_code=2)
    assert not (tmp_path / "model.json").exists()
