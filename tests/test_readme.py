"""The examples of the README, and of the pages that it hands details to, run as they are written; what they name exists."""

import re
import warnings
from pathlib import Path

import gymnasium
import pytest

import combrel_envs

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
PAGES = [README, *(ROOT / "docs" / f"{name}.md" for name in ("installation", "usage", "rl_zoo", "hub", "limitations"))]
SHORT_CAR = "ShortMountainCar4D-v0"
RULES = "\n".join(re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)).split()


def named(page):
    return page.name


def python_of(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)


def shortened(example):
    """The example with so few steps and seeds that it takes a moment."""
    short = re.sub(r"\b((?:total_time)?steps=|learn\()[\d_]{4,}", r"\g<1>100", example)
    return short.replace("seeds=10", "seeds=2").replace('compare("combrel/MountainCar4D-v0"', f'compare("{SHORT_CAR}"')


@pytest.fixture
def folder_and_short_task(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_COMBREL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    gymnasium.register(SHORT_CAR, gymnasium.spec("combrel/MountainCar4D-v0").entry_point, max_episode_steps=20)
    yield tmp_path
    del gymnasium.registry[SHORT_CAR]


def run_examples(page):
    """Each in a namespace of its own, as by someone who copies one block; what an earlier one has saved is there."""
    for example in python_of(page):
        with warnings.catch_warnings():
            warnings.filterwarnings("error", module="sb3_combrel")
            exec(compile(shortened(example), page.name, "exec"), {"__name__": "example"})


@pytest.mark.integration
def test_the_examples_of_the_readme_run(folder_and_short_task, capsys):
    run_examples(README)
    assert {"source.npz", "car.zip", "curves.png"} <= {path.name for path in folder_and_short_task.iterdir()}
    assert "Right on (x, vx)" in capsys.readouterr().out, "the mapping found is not shown by name"


@pytest.mark.integration
def test_the_examples_of_the_page_on_usage_run(folder_and_short_task, capsys):
    run_examples(ROOT / "docs/usage.md")
    assert {"source.npz", "car.zip", "logs"} <= {path.name for path in folder_and_short_task.iterdir()}
    assert "East: Right on (x, vx) as (x, v)" in capsys.readouterr().out, "the mapping is not as the comment says"


def test_examples_are_shortened():
    assert shortened("model.learn(total_timesteps=5_000)\ncompare(env, seeds=10, steps=3_000)\nagain.learn(5_000, x=1)") == (
        "model.learn(total_timesteps=100)\ncompare(env, seeds=2, steps=100)\nagain.learn(100, x=1)"
    )
    for page in PAGES:
        for example in python_of(page):
            assert not re.search(r"(steps=|seeds=|learn\()(?!2\b|100\b)\d\d", shortened(example))


def test_the_readme_is_short():
    assert len(README.read_text().splitlines()) < 200


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page):
    for file in re.findall(r"\]\((?!https?:|#)([^)#]+)[^)]*\)", page.read_text()):
        assert (page.parent / file).exists(), file


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_headings_that_links_name_exist(page):
    headings = {
        re.sub(r"[^\w -]", "", line).strip().lower().replace(" ", "-")
        for line in re.findall(r"^#+ (.*)", page.read_text(), re.M)
    }
    assert set(re.findall(r"\]\(#([^)]+)\)", page.read_text())) <= headings


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_the_make_targets_exist(page):
    assert set(re.findall(r"`make ([a-z-]+)|^make ([a-z-]+)$", page.read_text(), re.MULTILINE)) <= {
        pair for rule in RULES for pair in ((rule, ""), ("", rule))
    }


def test_the_readme_names_the_two_commands():
    assert "| `make demo` |" in README.read_text() and "| `make test` |" in README.read_text()


def test_all_that_is_exported_is_in_the_table_of_what_is_implemented():
    import sb3_combrel

    table = README.read_text().partition("## What is implemented")[2].partition("\n## ")[0]
    for name in sb3_combrel.__all__:
        assert re.search(rf"`{name}\b", table), name


def test_all_commands_are_in_the_table_of_commands():
    from sb3_combrel import cli

    table = README.read_text().partition("## What is implemented")[2].partition("\n## ")[0]
    assert set(re.findall(r"`sb3-combrel (\w+)", table)) == set(cli.COMMANDS)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_the_environments_exist(page):
    for env_id in set(re.findall(r"combrel/\w+-v\d", page.read_text())):
        gymnasium.make(env_id).close()
    for domain, task in re.findall(r'combrel_envs\.load\("(\w+)", "(\w+)"\)', page.read_text()):
        combrel_envs.load(domain, task)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_lines_are_as_short_as_elsewhere(page):
    """Apart from the rows of tables."""
    assert [line for line in page.read_text().splitlines() if len(line) > 127 and not line.startswith("|")] == []


def test_figures_are_small():
    for figure in (ROOT / "docs").rglob("*.png"):
        assert figure.stat().st_size < 300_000, figure
