"""The house rules that no linter knows."""

from __future__ import annotations

import ast
import graphlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from servolens.effects import CATALOGUE

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "servolens"
MODULES = sorted(PACKAGE.rglob("*.py"))
SLOW_TO_IMPORT = ("casadi", "control", "matplotlib", "numba", "pandas", "pint", "scipy")
LONGEST_MODULE, LONGEST_FUNCTION = 450, 50

each_module = pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def is_public(path: Path) -> bool:
    return not any(part.startswith("_") and part != "__init__.py" for part in path.relative_to(PACKAGE).parts)


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of the function without those of its docstring."""
    total = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is None:
        return total
    docstring = function.body[0]
    return total - (docstring.end_lineno - docstring.lineno + 1)


def imported(path: Path) -> set[str]:
    """Top-level names of everything that the module imports, inside functions too."""
    names: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.partition(".")[0])
    return names


def test_constraints_are_names_and_versions_only():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert pins
    assert [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+]+", pin)] == []


def test_constraints_pin_every_declared_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = [*project["dependencies"], *(d for extra in project["optional-dependencies"].values() for d in extra)]
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {normal(pin.partition("==")[0]) for pin in pins}
    assert {normal(re.match(r"[A-Za-z0-9._-]+", d)[0]) for d in declared} - pinned == set()


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@each_module
def test_public_module_has_a_docstring_and_names_what_it_offers(path):
    if not is_public(path):
        return
    module = tree(path)
    assert ast.get_docstring(module), "needs a docstring"
    targets = [t for node in module.body if isinstance(node, ast.Assign | ast.AnnAssign) for t in assigned(node)]
    assert "__all__" in targets, "needs __all__"


def assigned(node: ast.Assign | ast.AnnAssign) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [target.id for target in targets if isinstance(target, ast.Name)]


@each_module
def test_module_and_its_functions_are_short(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST_MODULE
    functions = [node for node in ast.walk(tree(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert {f.name: length(f) for f in functions if length(f) > LONGEST_FUNCTION} == {}


def test_no_modules_import_each_other_in_a_circle():
    names = {module_name(path): path for path in MODULES}
    graph = {name: needed(path, names) - {name} for name, path in names.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises and names the circle


def module_name(path: Path) -> str:
    parts = ("servolens", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def needed(path: Path, names: dict[str, Path]) -> set[str]:
    """Modules that this one imports when it runs, inside functions too; of a package's name, the module it stands for.

    What a package's own `__init__` takes from its parts is no dependence of those who import other parts of it.
    """
    found = set()
    for node in running(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            parts = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= parts & names.keys() or {node.module}
    return found & names.keys()


def running(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those that only a type checker reads."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and getattr(child.test, "id", "") == "TYPE_CHECKING":
            continue
        yield child
        yield from running(child)


@each_module
def test_nothing_is_pickled(path):
    assert imported(path) & {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "joblib", "marshal"} == set()
    assert "allow_pickle=True" not in path.read_text(encoding="utf-8")


@each_module
def test_every_silenced_check_carries_its_reason(path):
    text = path.read_text(encoding="utf-8")
    silenced = [
        line.strip() for line in text.splitlines() if re.search(r"#\s*(ruff:\s*)?noqa|#\s*type:\s*ignore", line)
    ]
    reasoned = re.compile(
        r"#\s*((ruff:\s*)?noqa:\s*[A-Z]+[0-9]+(,\s*[A-Z]+[0-9]+)*|type:\s*ignore\[[a-z, -]+\])\s+[-#–]\s*\w+"
    )
    assert [line for line in silenced if not reasoned.search(line)] == []


def test_importing_servolens_loads_nothing_slow():
    script = f"import sys, servolens; print(*sorted(set(sys.modules) & set({SLOW_TO_IMPORT!r})))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_the_catalogue_knows_every_effect_file():
    files = {path.stem for path in (PACKAGE / "effects").glob("[!_]*.py")} - {"base", "kinds"}
    modules = {effect.__module__.rpartition(".")[2] for effect in CATALOGUE.values()}
    assert modules == files
    assert all(effect.name == name for name, effect in CATALOGUE.items())
