"""Versions and commands are stated in several files, which must agree: pins, pre-commit, the workflow, the Makefile."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MAKEFILE = (ROOT / "Makefile").read_text()
PRE_COMMIT = (ROOT / ".pre-commit-config.yaml").read_text()
WORKFLOW = (ROOT / ".github/workflows/ci.yml").read_text()


def pins_of(text):
    """Versions by package name, lower case, of all that a text pins."""
    return {name.lower(): version for name, version in re.findall(r"([\w.-]+)==([\w.]+)", re.sub(r"#.*", "", text))}


def as_numbers(version):
    return tuple(map(int, version.split(".")))


PINS = pins_of((ROOT / "constraints.txt").read_text())
OLDEST = pins_of((ROOT / "tests/constraints-oldest.txt").read_text())


def test_pre_commit_runs_the_checks_of_the_makefile_in_the_versions_of_the_constraints():
    hooks = pins_of(PRE_COMMIT)
    assert set(hooks) == {"ruff", "black"} and hooks.items() <= PINS.items()
    assert set(re.findall(r"entry: make (\w+)", PRE_COMMIT)) == {"type", "lint"}


def test_the_workflow_tests_the_supported_versions_of_python_with_the_script_that_runs_everywhere():
    [matrix] = re.findall(r"python-version: \[(.+)\]", WORKFLOW)
    classifiers = [re.search(r":: (3\.\d+)$", line) for line in PROJECT["project"]["classifiers"]]
    assert re.findall(r"[\d.]+", matrix) == [found[1] for found in classifiers if found]
    assert "run: .ci/run\n" in WORKFLOW
    targets = re.findall(r"^make ([\w-]+)", (ROOT / ".ci/run").read_text(), flags=re.MULTILINE)
    assert targets == ["lint", "type", "check-codestyle", "test"]


@pytest.mark.parametrize("file", [".ci/run", ".github/workflows/ci.yml", ".pre-commit-config.yaml", "CONTRIBUTING.md"])
def test_the_make_targets_named_in_other_files_exist(file):
    rules = "\n".join(re.findall(r"^([\w -]+):", MAKEFILE, flags=re.MULTILINE)).split()
    assert set(re.findall(r"(?:^|[`\s])make ([a-z][a-z-]+)", (ROOT / file).read_text())) - {"sure"} <= set(rules)


@pytest.mark.parametrize("package", ["numba", "numpy"])
def test_pinned_versions_are_allowed_and_the_oldest_one_tested_is_the_oldest_allowed(package):
    [requirement] = [line for line in PROJECT["project"]["dependencies"] if re.match(rf"{package}\b", line)]
    lowest, above = (as_numbers(re.search(rf"{sign}([\d.]+)", requirement)[1]) for sign in (">=", "<"))
    assert lowest <= as_numbers(PINS[package]) < above and as_numbers(OLDEST[package])[: len(lowest)] == lowest
    if package == "numba":  # a new minor version is tried, and pinned, before it is allowed
        assert as_numbers(PINS["numba"])[:2] == (above[0], above[1] - 1)


LAYERS = [contract for contract in PROJECT["tool"]["importlinter"]["contracts"] if contract["type"] == "layers"]


@pytest.mark.parametrize("contract", LAYERS, ids=lambda contract: contract["containers"][0])
def test_every_layer_of_the_import_contracts_exists_and_every_module_is_in_one(contract):
    [container] = contract["containers"]
    folder = ROOT / container.replace(".", "/")
    on_disk = {path.stem for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    named = [name.strip() for layer in contract["layers"] for name in re.split("[|:]", layer)]
    assert sorted(named + contract.get("exhaustive_ignores", [])) == sorted(on_disk - {"__init__"})


def test_an_interpreter_that_does_not_run_is_told_by_its_first_line(tmp_path):
    """That of pyenv says more, in six lines, at the end of which nobody finds what is needed."""
    python = tmp_path / "python3.13"
    python.write_text("#!/bin/sh\nprintf 'command not found\\nThis and that\\n' >&2\nexit 127\n")
    python.chmod(0o755)
    given = f"PYTHON={python}", f"VENV={tmp_path / 'venv'}", "TORCH_INDEX="
    made = subprocess.run(["make", "lint", *given], cwd=ROOT, capture_output=True, text=True)
    assert made.returncode != 0 and not (tmp_path / "venv").exists()
    assert f"{python} is command not found; Python 3.11, 3.12 or 3.13 is needed: make PYTHON=" in made.stderr
