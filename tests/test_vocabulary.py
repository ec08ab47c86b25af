"""One name, one thing: class names, error codes and log events of the whole project, read from its source."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

from schemas.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT: Final = Path(__file__).parents[1]
REFERENCE: Final = ROOT / "docs" / "reference"
PACKAGES: Final = ("schemas", "mesh", "bridges")
SHARED: Final = {
    "Job": "what a robot works on, and what a program has ordered of a signer",
    "Log": "the name that Ethereum gives an entry of a receipt, and Foxglove a line of a log",
    "Policy": "how a validator judges results, and what programs may order",
    "Signer": "what signs with a key, and the process that does so for programs",
    "Market": "what a test trades on, and what the page knows of the market that it shows",
    "Robot": "what is present on a market, and what a program that speaks ROS 2 gives its node to",
}
"""Class names that are defined in several modules on purpose, each with the reason."""
LEVELS: Final = frozenset({"info", "warning", "error", "exception", "critical"})
KEBAB: Final = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


@cache
def sources() -> tuple[tuple[str, ast.Module], ...]:
    """Every module's path and its syntax tree; read by the first test that needs them."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return tuple((str(path.relative_to(ROOT)), ast.parse(path.read_text())) for path in paths)


def error_classes(root: type[AiraError] = AiraError) -> Iterator[type[AiraError]]:
    for kind in root.__subclasses__():
        yield kind
        yield from error_classes(kind)


def is_log_call(node: ast.AST) -> bool:
    match node:
        case ast.Call(func=ast.Attribute(value=ast.Name(id="log" | "_log"), attr=level)):
            return level in LEVELS
    return False


def event_of(call: ast.Call, function: ast.AST) -> ast.expr | None:
    """The first argument of `log_event(…)` in `extra`, given there or by a local variable."""
    extra = next((keyword.value for keyword in call.keywords if keyword.arg == "extra"), None)
    if isinstance(extra, ast.Name):
        assigned = [
            node.value
            for node in ast.walk(function)
            if isinstance(node, ast.Assign) and any(ast.unparse(target) == extra.id for target in node.targets)
        ]
        extra = assigned[-1] if assigned else None
    if isinstance(extra, ast.Call) and ast.unparse(extra.func).endswith("log_event"):
        return extra.args[0]
    return None


def test_a_class_name_is_defined_in_one_module() -> None:
    homes: dict[str, set[str]] = defaultdict(set)
    for path, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                homes[node.name].add(path)

    assert {name: sorted(paths) for name, paths in homes.items() if len(paths) > 1 and name not in SHARED} == {}


def test_a_record_of_limits_is_defined_in_one_module() -> None:
    homes: dict[str, set[str]] = defaultdict(set)
    for path, tree in sources():
        for node in tree.body:
            if isinstance(node, ast.AnnAssign) and re.fullmatch(r"[A-Z]\w+_(LIMITS|PACE)", ast.unparse(node.target)):
                homes[ast.unparse(node.target)].add(path)

    assert homes
    assert {name: sorted(paths) for name, paths in homes.items() if len(paths) > 1} == {}


def imported(tree: ast.AST) -> set[str]:
    """The modules, and the names in them, that a module imports."""
    names = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}", *(f"{node.module}.{name.name}" for name in node.names)}
    return names


def test_modules_that_only_their_package_imports_begin_with_an_underscore() -> None:
    others = [(path, imported(tree)) for path, tree in sources()]
    others += [(f"bench/{path.name}", imported(ast.parse(path.read_text()))) for path in (ROOT / "bench").glob("*.py")]
    entry_points = set(re.findall(r'"([\w.]+):\w+"', (ROOT / "pyproject.toml").read_text()))
    others.append(("pyproject.toml", entry_points))
    misnamed = []
    for path, _ in sources():
        package, name = path.removesuffix(".py").rsplit("/", 1)
        # What stands at the top is everybody's, and commands are named by what people type.
        if name.startswith("__") or package in (*PACKAGES, "mesh/cli"):
            continue
        module = f"{package}/{name}".replace("/", ".")
        is_public = any(module in names for other, names in others if not other.startswith(f"{package}/"))
        if is_public == name.startswith("_"):
            misnamed.append(path)

    assert misnamed == []


def import_everything() -> None:
    for path, _ in sources():
        if "__main__" not in path:
            import_module(path.removesuffix(".py").removesuffix("/__init__").replace("/", "."))


def codes_of_errors() -> dict[str, str | None]:
    """The code of each class, by its name: another test may have loaded a module, and so a class, a second time."""
    import_everything()
    ours = (kind for kind in error_classes() if kind.__module__.startswith(PACKAGES))
    return {f"{kind.__module__}.{kind.__qualname__}": kind.__dict__.get("code") for kind in ours}


def codes_of_raised() -> set[str]:
    """The codes that errors are given where they are raised: `ConfigurationError("…", code="files-missing")`."""
    classes = {name.rsplit(".", 1)[1] for name in codes_of_errors()} | {"AiraError", "super().__init__"}
    return {
        str(keyword.value.value)
        for _, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func).removeprefix("errors.") in classes
        for keyword in node.keywords
        if keyword.arg == "code" and isinstance(keyword.value, ast.Constant)
    }


def documented(page: str, heading: str) -> set[str]:
    """The names in the first column of a table of a page in docs/reference."""
    return set(re.findall(r"^\| `([\w-]+)` \|", section(page, heading), re.MULTILINE))


def section(page: str, heading: str) -> str:
    return re.split(rf"^#+ {heading}\n", (REFERENCE / page).read_text(), flags=re.MULTILINE)[1].split("\n## ")[0]


def test_every_error_class_has_a_code_of_its_own() -> None:
    codes = codes_of_errors()

    assert all(code and KEBAB.fullmatch(code) for code in codes.values()), codes
    assert len(set(codes.values())) == len(codes)


def test_the_documented_error_codes_are_those_of_the_source() -> None:
    assert documented("codes.md", "Errors") == set(codes_of_errors().values()) | codes_of_raised()


def test_the_documented_error_classes_are_those_of_the_codes() -> None:
    classes = {code: name.rsplit(".", 1)[1] for name, code in codes_of_errors().items()}
    rows = re.findall(r"^\| `([\w-]+)` \| `(\w+)` \|", section("codes.md", "Errors"), re.MULTILINE)

    assert {code: name for code, name in rows if classes.get(code, name) != name} == {}
    assert {name for _, name in rows} <= {"AiraError", *classes.values()}


def test_the_documented_log_events_are_those_of_the_source() -> None:
    names = set()
    for _, tree in sources():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Name(id="log_event"), args=[ast.Constant(value=str(name)), *_]):
                    names.add(name)
                case ast.Call(func=ast.Name(id="announce"), args=[_, ast.Constant(value=str(name)), *_]):
                    names.add(name)
                case ast.Call(func=ast.Name(id="OutageLog"), args=[_, ast.Constant(value=str(name))]):
                    names |= {f"{name}-outage", f"{name}-recovered"}

    assert documented("log-events.md", "Log events") == names


def test_the_documented_codes_of_the_doctor_are_those_of_the_source() -> None:
    codes = {"ok"}
    for path, tree in sources():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Name(id="passed" | "warning" | "failed"), keywords=keywords) if (
                    "doctor/" in path or path.endswith(("/check.py", "ipfs/daemon.py"))
                ):
                    given = [keyword.value for keyword in keywords if keyword.arg == "code"]
                    parts = [part for code in given for part in ast.walk(code)]
                    codes |= {str(part.value) for part in parts if isinstance(part, ast.Constant)}

    assert documented("checks.md", "Doctor") == codes


def test_every_log_event_has_a_stable_name() -> None:
    assert [fault for path, tree in sources() for fault in faults_of_logging(path, tree)] == []


def faults_of_logging(path: str, tree: ast.Module) -> Iterator[str]:
    functions: list[ast.AST] = [
        node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    for function in functions or [tree]:
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and is_log_call(node):
                name = event_of(node, function)
                if name is None:
                    yield f"{path}:{node.lineno}: no `extra=log_event(…)`"
                elif isinstance(name, ast.Constant) and (
                    not KEBAB.fullmatch(str(name.value)) or name.value == "unnamed"
                ):
                    yield f"{path}:{node.lineno}: {name.value!r} is not a stable name"
