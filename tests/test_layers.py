"""Imports go down only, from room to room, also those that are delayed, for type checking alone, or by name."""

import ast
import importlib.util
from pathlib import Path

import pytest

PACKAGE = "sb3_combrel"
FOLDER = Path(__file__).resolve().parent.parent / PACKAGE
#: From top to bottom; the package itself, for `from sb3_combrel import COMBREL`, is a room among the others.
ROOMS = [
    *("cli", "experiments", "zoo", PACKAGE, "callbacks", "tensorboard", "comparison", "runs", "pages", "fitted_rmax"),
    *("transfer", "sources", "mappings", "models", "planning", "wrappers", "common"),
]


def room_of(module):
    """The room that a module of the package, or a name in one, belongs to."""
    second = [*module.split("."), ""][1]
    return second if second in ROOMS else PACKAGE


def imported_by(text, package):
    """Names that a module's text imports, with their lines; ``package``: the one that the module is in."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            names = [f"{origin}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            strings = [
                given.value
                for given in [*node.args, *(keyword.value for keyword in node.keywords)]
                if isinstance(given, ast.Constant) and isinstance(given.value, str)
            ]
            names = [importlib.util.resolve_name(name, package) for name in strings[:1]]
        else:
            continue
        yield from ((name, node.lineno) for name in names)


def arrows_up(text, module, package):
    """Imports of a module of the package that go up, each as a sentence."""
    here = room_of(module)
    for name, line in imported_by(text, package):
        if name.split(".")[0] == PACKAGE and ROOMS.index(room_of(name)) < ROOMS.index(here):
            yield f"{module}, line {line}: {here} imports {name}, of {room_of(name)}"


def test_imports_go_down():
    found = []
    for path in sorted(FOLDER.rglob("*.py")):
        parts = [PACKAGE, *path.relative_to(FOLDER).with_suffix("").parts]
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found += arrows_up(path.read_text(encoding="utf-8"), module, ".".join(parts[:-1]))
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "up",
    [
        *("import sb3_combrel.zoo.hub as hub", "import sb3_combrel", "from sb3_combrel import COMBREL"),
        *("from sb3_combrel import models", "from ..models.base import Model", "from .. import cli"),
        *("importlib.import_module('sb3_combrel.cli')", "import_module('..cli', package=__package__)"),
        *("__import__('sb3_combrel.fitted_rmax.agent')", "if TYPE_CHECKING:\n        from sb3_combrel.sources import recipes"),
    ],
)
def test_a_delayed_import_up_is_found(up):
    text = f"import numpy\nfrom sb3_combrel.common import files\ndef late():\n    {up}\n"
    assert len(list(arrows_up(text, "sb3_combrel.planning.made_up", "sb3_combrel.planning"))) == 1


def test_imports_down_and_of_others_are_none():
    text = "import numpy\nfrom sb3_combrel import COMBREL\nfrom . import pages\nfrom ..zoo import hub\nimport_module(name)\n"
    assert not list(arrows_up(text, "sb3_combrel.experiments.made_up", "sb3_combrel.experiments"))
