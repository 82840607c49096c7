"""README and pages: Python in them runs, what they name exists, links lead somewhere, and Sphinx builds them."""

import functools
import importlib.util
import inspect
import re
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from helpers.pages import DOCS, ROOT, anchors, blocks, commands, links, name_of, pages, prose
from PIL import Image

import combrel_envs  # noqa: F401 - registers the environments
import sb3_combrel
from sb3_combrel import cli
from sb3_combrel.experiments import concept

PAGES = pages()
README = ROOT / "README.md"
# Each block of these can be copied alone; those of other pages follow each other. hub.md: tests/zoo/test_hub.py.
BLOCK_BY_BLOCK = [README, DOCS / "usage.md"]
WITH_PYTHON = [page for page in PAGES if page.parent == DOCS and page.stem != "hub" and blocks(page.read_text(), "python")]
WITH_COMMANDS = [page for page in PAGES if DOCS in page.parents and commands(page.read_text())]
TARGETS = set(" ".join(re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)).split())
OTHER_WORDS = {"for", "done", "pip", "ray", "dask", "tensorboard", "export"}
SHORT_CAR = "ShortMountainCar4D-v0"


def shortened(code):
    """Code of a page with few steps and seeds; a source keeps enough for 1000 instances, `compare` gets short episodes."""

    def fewer(found):
        n = int(found[2])
        return f"{found[1]}{min(n, 1_100 if n >= 10_000 else 300)}"

    short = re.sub(r"((?:steps\"?[=:] ?)|(?:learn\())([\d_]+)", fewer, code)
    return re.sub(r"seeds=\d+", "seeds=2", short).replace('compare("combrel/MountainCar4D-v0"', f'compare("{SHORT_CAR}"')


@pytest.mark.long
@pytest.mark.parametrize("page", [README, *WITH_PYTHON], ids=name_of)
def test_python_of_a_page_runs(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_COMBREL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    gymnasium.register(SHORT_CAR, gymnasium.spec("combrel/MountainCar4D-v0").entry_point, max_episode_steps=20)
    names = {}
    for code in blocks(page.read_text(), "python"):
        names = {} if page in BLOCK_BY_BLOCK else names
        # As in a script of a user: what it defines goes to other processes as a whole.
        names["__name__"] = "example" if page in BLOCK_BY_BLOCK else "__main__"
        exec(compile(shortened(code), page.name, "exec"), names)
    del gymnasium.registry[SHORT_CAR]
    if page == README:
        assert {"source.npz", "car.zip", "curves.png"} <= {path.name for path in tmp_path.iterdir()}
        assert "Right on (x, vx)" in capsys.readouterr().out, "the mapping found is not shown by name"


@pytest.fixture
def cli_without_work(monkeypatch):
    """The command line, whose commands check their arguments and do nothing; the list of calls."""
    calls = []

    def idle(command):
        @functools.wraps(command)
        def record(*args, **kwargs):
            calls.append(inspect.signature(command).bind(*args, **kwargs))

        return record

    monkeypatch.setattr(cli, "COMMANDS", {name: idle(command) for name, command in cli.COMMANDS.items()})
    return calls


@pytest.mark.parametrize("page", [README, *WITH_COMMANDS], ids=name_of)
def test_commands_exist(page, cli_without_work):
    n_calls = 0
    for words in commands(page.read_text()):
        while words and re.match(r"[A-Z_]+=", words[0]):
            words = words[1:]
        if not words:
            continue
        if words[0] == "sb3-combrel":
            assert cli.main(words[1:]) == 0, words
            n_calls += 1
        elif words[:2] == ["python", "-m"]:
            check_module_call(words[2], words[3:])
        else:
            assert words[0] in OTHER_WORDS or (words[0] == "make" and words[1] in TARGETS), words
    assert len(cli_without_work) == n_calls


def check_module_call(module, words):
    """Check that a module can be run, that it knows the options, and that files and algorithms exist."""
    assert importlib.util.find_spec(module) is not None, module
    if module.startswith("sb3_combrel.experiments."):
        # The command is the function that the module is named after, or, of "suite.command", its folder.
        name = module.replace(".command", "").rpartition(".")[2]
        parameters = inspect.signature(getattr(importlib.import_module(module), name)).parameters
        known = {f"--{parameter.replace('_', '-')}" for parameter in parameters}
        assert {word for word in words if word.startswith("--")} <= known, (module, words)
    if module == "sb3_combrel.zoo":
        from sb3_combrel.zoo import ALGORITHMS
        from sb3_combrel.zoo.commands import FUNCTIONS, SCRIPTS

        after = dict(zip(words, [*words[1:], ""], strict=True))
        assert words[0] in FUNCTIONS | SCRIPTS, words
        assert after.get("--algo", "combrel") in {*ALGORITHMS, "$algo"}, words
        assert (ROOT / after.get("--conf-file", "").replace("$algo", "combrel")).exists(), words


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_what_a_page_names_exists_and_its_lines_are_short(page):
    text = page.read_text()
    named = re.findall(r"`make ([a-z-]+)|^make ([a-z-]+)$", text, re.MULTILINE)
    assert {first or second for first, second in named} <= TARGETS
    for env_id in set(re.findall(r"combrel/\w+-v\d", text)):
        gymnasium.spec(env_id)
    for name, target in re.findall(r"\[`([A-Za-z_]\w*)`\]\(([^()\s]+\.py)\)", text):
        source = (page.parent / target).read_text()
        assert re.search(rf"^\s*(def|class) {name}\b|^{name}\b.*=", source, flags=re.MULTILINE), (name, target)
    # Apart from the rows of tables, and from reports of results, which a command writes.
    long = [line for line in prose(text).splitlines() if len(line) > 127 and not line.startswith("|")]
    assert long == [] or page.parent.parent == DOCS / "results"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files_and_headings(page):
    for target in links(page.read_text()):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists() and ROOT in file.parents, f"{name_of(page)} links to {target}"
        assert not anchor or anchor in anchors(file.read_text()), f"{name_of(page)} links to {target}: no such heading"


def test_links_and_anchors_are_found():
    text = "# A title: `code`, and more\n\n[one](a.md) ![two](b.png)\n[three](c.md#d) [site](https://e.org)\n"
    text += "\n## Notes\n\n## Notes\n"
    code = "```sh\n# no heading\n[no](link)\n```\n"
    assert links(text + code) == ["a.md", "b.png", "c.md#d"]
    assert anchors(text + code) == {"a-title-code-and-more", "notes", "notes-1"}


def test_the_readme_is_short_and_its_tables_have_all_that_is_exported_and_all_commands():
    text = README.read_text()
    assert len(re.sub(r"<!--.*?-->\n", "", text, flags=re.DOTALL).splitlines()) < 200
    table = text.partition("## What is implemented")[2].partition("\n## ")[0]
    assert [name for name in sb3_combrel.__all__ if not re.search(rf"`{name}\b", table)] == []
    assert set(re.findall(r"`sb3-combrel (\w+)", table)) == set(cli.COMMANDS)
    pages_as_one = "\n".join(page.read_text() for page in PAGES)
    documented = re.findall(r"\.\. auto(?:class|function):: sb3_combrel\.(\w+)$", pages_as_one, re.MULTILINE)
    assert set(documented) == set(sb3_combrel.__all__)


def test_every_equation_and_line_of_algorithm_1_has_its_function():
    text = (DOCS / "equations.md").read_text()
    algorithm, equations = (re.split(r"\n#", text.partition(f"### {part}")[2])[0] for part in ("Algorithm 1", "Equations"))
    assert sorted(numbers_of(re.findall(r"^\| (\d[^|]*)\|", algorithm, flags=re.MULTILINE))) == list(range(1, 28))
    assert set(numbers_of(re.findall(r"^\| ([\d, ]+)\|", equations, flags=re.MULTILINE))) == set(range(1, 8))
    source = (ROOT / "sb3_combrel" / "transfer" / "equations.py").read_text()
    named = set(re.findall(r"\[`(\w+)`\]\([^)]*transfer/equations\.py\)", text))
    assert named == set(re.findall(r"^def (\w+)", source, flags=re.MULTILINE))


def numbers_of(cells):
    """The numbers in cells such as "1, 3, 9 to 11"."""
    parts = [part.strip().partition(" to ") for cell in cells for part in cell.split(",")]
    return [n for first, _, last in parts for n in range(int(first), int(last or first) + 1)]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_code_host_shows_no_directives(page):
    assert not re.search(
        r"^```\{|^\.\. auto", re.sub(r"^<!--.*?-->", "", page.read_text(), flags=re.DOTALL | re.MULTILINE), re.M
    )


def test_every_page_is_in_the_contents_and_figures_are_small():
    assert [figure for figure in DOCS.rglob("*.png") if figure.stat().st_size > 300_000] == []
    index = (DOCS / "index.md").read_text()
    blocks_of_contents = re.findall(r"^<!-- sphinx: toctree\n(.*?)^-->$", index, flags=re.DOTALL | re.MULTILINE)
    listed = {name for block in blocks_of_contents for name in block.split()}
    names = {path.relative_to(DOCS).with_suffix("").as_posix() for path in [*DOCS.glob("*.md"), *DOCS.glob("results/*.md")]}
    assert names - {"index"} <= listed
    # A code host does not show the table of contents.
    assert [name for name in names - {"index"} if f"]({name}.md)" not in index] == []


@pytest.mark.parametrize("name", ["fitted_rmax", "timbrel", "combrel", "other_methods"])
def test_pages_of_algorithms_have_the_order_of_sb3_contrib(name):
    headings = re.findall(r"^## (.*)$", (DOCS / f"{name}.md").read_text(), flags=re.MULTILINE)
    assert headings == ["Notes", "Can I use?", "Example", "Results", "How to replicate the results", "Parameters"]


def test_the_picture_of_the_idea_is_the_one_that_its_code_draws(tmp_path):
    concept.main(tmp_path / "concept.png")
    pictures = [Image.open(folder / "concept.png").convert("RGB") for folder in (tmp_path, DOCS / "figures")]
    drawn, kept = (np.asarray(picture, dtype=float) for picture in pictures)
    # Versions of matplotlib and FreeType differ in single pixels.
    assert drawn.shape == kept.shape and np.abs(drawn - kept).mean() < 2.0
    assert (DOCS / "figures/concept.png").stat().st_size <= 150_000
    assert all("figures/concept.png)" in page.read_text() for page in (README, DOCS / "index.md"))


@pytest.mark.long
def test_sphinx_builds_the_pages_without_warnings(tmp_path):
    options = ["-W", "--keep-going", "-q", "-c", DOCS, "-b", "html", "-d", tmp_path / "doctrees", ROOT, tmp_path / "html"]
    done = subprocess.run([sys.executable, "-m", "sphinx", *options], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "html" / "docs" / "combrel.html").read_text()
    assert "min_compliance" in page and "COmpliance-aware" in page
    environments = (tmp_path / "html" / "docs" / "environments.html").read_text()
    assert environments.count("Observation Space") == 5 and "<td><p>velocity along y</p></td>" in environments
