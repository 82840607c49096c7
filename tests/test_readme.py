"""The examples of the README run as they are written."""

import re
from pathlib import Path

import gymnasium
import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.integration
def test_the_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    for example in PYTHON:
        short, n_changes = re.subn(r"total_timesteps=[\d_]+", "total_timesteps=100", example)
        assert n_changes <= 1
        exec(compile(short, "README.md", "exec"), names)
    assert (tmp_path / "source.npz").exists()
    assert (tmp_path / "car.zip").exists()
    assert "East: Right on (x, vx)" in capsys.readouterr().out, "the mapping found is not shown by name"


@pytest.mark.parametrize("file", re.findall(r"\]\((?!http)([^)]+)\)", README))
def test_links_lead_somewhere(file):
    assert (ROOT / file).exists()


def test_the_make_targets_exist():
    named = set(re.findall(r"make ([a-z-]+)", README))
    rules = "\n".join(re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)).split()
    assert {"demo", "test"} <= named <= set(rules)


def test_the_environments_exist():
    import combrel_envs

    for env_id in set(re.findall(r"combrel/\w+-v\d", README)):
        gymnasium.make(env_id).close()
    for domain, task in re.findall(r'combrel_envs\.load\("(\w+)", "(\w+)"\)', README):
        combrel_envs.load(domain, task)


def test_figures_are_small():
    for figure in (ROOT / "docs").rglob("*.png"):
        assert figure.stat().st_size < 300_000, figure
