"""The pages of docs/: Python in them runs, commands exist, links lead somewhere, and Sphinx builds them without warnings."""

import functools
import importlib.util
import inspect
import itertools
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
from helpers.pages import DOCS, ROOT, anchors, blocks, commands, links, name_of, pages

from sb3_combrel import cli

PAGES = pages()
# Run by tests/test_readme.py, and by tests/zoo/test_hub.py against a folder in place of the hub.
RUN_ELSEWHERE = {"usage", "hub"}
WITH_PYTHON = [
    page for page in PAGES if page.parent == DOCS and page.stem not in RUN_ELSEWHERE and blocks(page.read_text(), "python")
]
WITH_COMMANDS = [page for page in PAGES if DOCS in page.parents and commands(page.read_text())]
MAKEFILE = (ROOT / "Makefile").read_text()
MODULES = {
    *(f"sb3_combrel.experiments.{name}" for name in ("suite", "breadths", "icub", "tutorials")),
    *("sb3_combrel.zoo", "sphinx"),
}
LOOPS = {"for", "done"}
OTHER_PROGRAMS = {"pip", "ray", "dask", "tensorboard"}


def shortened(code):
    """Code of a page with fewer steps and seeds, so that it takes seconds; a source keeps enough for 1000 instances."""

    def fewer(found):
        n = int(found[2])
        return f"{found[1]}{min(n, 1_100 if n >= 10_000 else 300)}"

    return re.sub(r"seeds=\d+", "seeds=2", re.sub(r"(steps\"?[=:] ?)([\d_]+)", fewer, code))


@pytest.mark.parametrize(
    ("code", "short"),
    [
        ("model.learn(total_timesteps=5_000)", "model.learn(total_timesteps=300)"),
        ("from_q_learning(env, total_timesteps=30_000)", "from_q_learning(env, total_timesteps=1100)"),
        ('{"env": "A-v0", "total_timesteps": 30_000}', '{"env": "A-v0", "total_timesteps": 1100}'),
        ("compare(env, methods, seeds=10, steps=200)", "compare(env, methods, seeds=2, steps=200)"),
    ],
)
def test_long_runs_are_shortened(code, short):
    assert shortened(code) == short


@pytest.mark.integration
@pytest.mark.parametrize("page", WITH_PYTHON, ids=name_of)
def test_python_runs_from_the_top_of_a_page_to_its_end(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_COMBREL_CACHE", str(tmp_path / "cache"))
    # As in a script of a user: what it defines goes to other processes as a whole.
    names = {"__name__": "__main__"}
    for code in blocks(page.read_text(), "python"):
        exec(compile(shortened(code), page.name, "exec"), names)


def test_pages_with_python_are_found():
    found = {page.stem for page in WITH_PYTHON}
    assert {"fitted_rmax", "timbrel", "combrel", "mappings", "sources", "environments", "your_own_environments"} <= found


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


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=name_of)
def test_commands_exist(page, cli_without_work):
    n_calls = 0
    for words in commands(page.read_text()):
        while re.match(r"[A-Z_]+=", words[0]):
            words = words[1:]
        if words[0] in LOOPS:
            continue
        if words[0] == "sb3-combrel":
            assert cli.main(words[1:]) == 0, words
            n_calls += 1
        elif words[0] == "make":
            assert re.search(rf"^{words[1]}:", MAKEFILE, flags=re.MULTILINE), words
        elif words[:2] == ["python", "-m"]:
            check_module_call(words[2], words[3:])
        else:
            assert words[0] in OTHER_PROGRAMS, words
    assert len(cli_without_work) == n_calls


def test_a_command_with_a_wrong_option_is_found(cli_without_work):
    with pytest.raises(SystemExit):
        cli.main(["reproduce", "fig2", "--episode-count", "10"])
    with pytest.raises(AssertionError):
        check_module_call("sb3_combrel.experiments.suite.command", ["--sedes", "0-9"])
    with pytest.raises(AssertionError):
        check_module_call("sb3_combrel.zoo", ["train", "--algo", "combrell"])


def check_module_call(module, words):
    """Check that a module can be run, that it knows the options, and that files and algorithms exist."""
    assert module in MODULES and importlib.util.find_spec(module) is not None, module
    options = {word for word in words if word.startswith("--")}
    if module.startswith("sb3_combrel.experiments."):
        source = inspect.getsource(importlib.import_module(module))
        assert options <= set(re.findall(r'"(--[\w-]+)"', source)), (module, words)
    if module == "sb3_combrel.zoo":
        from sb3_combrel.zoo import ALGORITHMS
        from sb3_combrel.zoo.commands import FUNCTIONS, SCRIPTS

        words = [word.replace("$algo", "combrel") for word in words]
        assert words[0] in FUNCTIONS | SCRIPTS, words
        algorithms = [name for option, name in itertools.pairwise(words) if option == "--algo"]
        assert set(algorithms) <= set(ALGORITHMS) and len(algorithms) == ("-a" not in words), words
        files = [name for option, name in itertools.pairwise(words) if option == "--conf-file"]
        assert all((ROOT / name).is_file() for name in files) and len(files) == (words[0] == "train"), words


def test_the_environments_exist():
    import combrel_envs  # noqa: F401 - registers them

    for page in PAGES:
        for env_id in set(re.findall(r"combrel/\w+-v\d", page.read_text())):
            gymnasium.spec(env_id)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files_and_headings(page):
    text = page.read_text()
    for target in links(text):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{name_of(page)} links to {target}, which does not exist"
        assert ROOT in file.parents, f"{name_of(page)} links to {target}, outside the repository"
        if anchor:
            assert anchor in anchors(file.read_text()), f"{name_of(page)} links to {target}: no such heading"


def test_links_and_anchors_are_found():
    text = "# A title: `code`, and more\n\n[one](a.md) ![two](b.png)\n[three](c.md#d) [site](https://e.org)\n"
    text += "\n## Notes\n\n## Notes\n"
    code = "```sh\n# no heading\n[no](link)\n```\n"
    assert links(text + code) == ["a.md", "b.png", "c.md#d"]
    assert anchors(text + code) == {"a-title-code-and-more", "notes", "notes-1"}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_what_is_named_beside_a_link_to_a_module_is_defined_there(page):
    for name, target in re.findall(r"\[`([A-Za-z_]\w*)`\]\(([^()\s]+\.py)\)", page.read_text()):
        source = (page.parent / target).read_text()
        assert re.search(rf"^\s*(def|class) {name}\b|^{name}\b.*=", source, flags=re.MULTILINE), (name, target)


def test_every_equation_and_line_of_algorithm_1_has_its_function():
    text = (DOCS / "equations.md").read_text()
    lines = section(text, "### Algorithm 1")
    of_lines = [row.split("|")[1] for row in lines.splitlines() if re.match(r"\| \d", row)]
    assert sorted(n for cell in of_lines for n in numbers_of(cell)) == list(range(1, 28))
    equations = section(text, "### Equations")
    rows = [row.split("|")[1] for row in equations.splitlines() if re.match(r"\| [\d, ]+\|", row)]
    assert {n for cell in rows for n in numbers_of(cell)} == set(range(1, 8))


def test_every_function_of_the_equations_is_named():
    source = (ROOT / "sb3_combrel" / "transfer" / "equations.py").read_text()
    named = set(re.findall(r"\[`(\w+)`\]\([^)]*transfer/equations\.py\)", (DOCS / "equations.md").read_text()))
    assert named == set(re.findall(r"^def (\w+)", source, flags=re.MULTILINE))


def section(text, heading):
    start = text.index(heading)
    return text[start : text.index("\n#", start + 1)]


def numbers_of(cell):
    """The numbers in "1, 3, 9 to 11"."""
    found = []
    for part in cell.split(","):
        first, _, last = part.strip().partition(" to ")
        found += range(int(first), int(last or first) + 1)
    return found


def test_every_page_is_in_the_contents():
    index = (DOCS / "index.md").read_text()
    listed = {name for block in re.findall(r"```\{toctree\}\n(.*?)```", index, flags=re.DOTALL) for name in block.split()}
    for page in [*DOCS.glob("*.md"), *(DOCS / "results").glob("*.md")]:
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        if name != "index":
            assert name in listed
            assert f"]({name}.md)" in index, "a code host does not show the table of contents"


@pytest.mark.parametrize("name", ["fitted_rmax", "timbrel", "combrel", "other_methods"])
def test_pages_of_algorithms_have_the_order_of_sb3_contrib(name):
    headings = re.findall(r"^## (.*)$", (DOCS / f"{name}.md").read_text(), flags=re.MULTILINE)
    assert headings == ["Notes", "Can I use?", "Example", "Results", "How to replicate the results", "Parameters"]


def test_every_exported_class_is_documented():
    import sb3_combrel

    text = "\n".join(page.read_text() for page in DOCS.glob("*.md"))
    documented = set(re.findall(r"\.\. auto(?:class|function):: sb3_combrel\.(\w+)$", text, flags=re.MULTILINE))
    assert documented == set(sb3_combrel.__all__)


@pytest.mark.integration
def test_sphinx_builds_the_pages_without_warnings(tmp_path):
    options = ["-W", "--keep-going", "-q", "-c", DOCS, "-b", "html", "-d", tmp_path / "doctrees", ROOT, tmp_path / "html"]
    done = subprocess.run([sys.executable, "-m", "sphinx", *options], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "html" / "docs" / "combrel.html").read_text()
    assert "min_compliance" in page and "COmpliance-aware" in page
    environments = (tmp_path / "html" / "docs" / "environments.html").read_text()
    assert environments.count("Observation Space") == 5 and "<td><p>velocity along y</p></td>" in environments
    assert Path(tmp_path / "html" / "docs" / "index.html").is_file()
