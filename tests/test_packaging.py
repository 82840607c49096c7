"""What a user installs: the wheel's contents, its metadata, and what importing the package costs."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import sb3_combrel

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
WHERE = {"sb3_combrel": ROOT / "sb3_combrel", "combrel_envs": ROOT / "envs" / "combrel_envs"}
BESIDE = ["CHANGELOG.md", "CITATION.cff", "MANIFEST.in", "constraints.txt", "LICENSE", "README.md", "pyproject.toml"]
DATA = {"py.typed", "version.txt", "*.xml", "*.yml", "*.png", "*.html", "*.LICENSE.md"}


def files_on_disk(package):
    """The files of a package that belong into a wheel, by their path in it."""
    return {
        f"{package}/{path.relative_to(WHERE[package]).as_posix()}"
        for path in WHERE[package].rglob("*")
        if path.suffix == ".py" or any(path.match(pattern) for pattern in DATA)
    }


def configurations():
    """RL-Zoo's settings, which the wheel has inside the package, by their path in it."""
    return {f"sb3_combrel/zoo/configs/{path.name}": path for path in (ROOT / "zoo_configs").iterdir() if path.is_file()}


def run(*command, **options):
    done = subprocess.run([sys.executable, *map(str, command)], capture_output=True, text=True, timeout=300, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_folder_with_modules_is_a_package_that_is_listed():
    folders = {Path(name).parent for package in WHERE for name in files_on_disk(package) if name.endswith(".py")}
    listed = {*PROJECT["tool"]["setuptools"]["packages"]} - {"sb3_combrel.zoo.configs"}
    assert listed == {".".join(folder.parts) for folder in folders}
    assert all((WHERE[folder.parts[0]].parent / folder / "__init__.py").exists() for folder in folders)


def test_versions_agree():
    version = sb3_combrel.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+\w*", version) and f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{version}] - 20" in (ROOT / "CHANGELOG.md").read_text()


def test_all_contains_every_extra_but_those_of_developers_and_rivals():
    (line,) = EXTRAS["all"]
    assert set(re.fullmatch(r"sb3-combrel\[(.+)\]", line)[1].split(",")) == set(EXTRAS) - {"all", "benchmarks", "dev", "docs"}


def test_constraints_pin_all_that_is_required():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = {normal(line.split("==")[0]) for line in lines if line and not line.startswith("#")}
    required = {normal(re.match(r"[\w.-]+", line)[0]) for line in sum(EXTRAS.values(), PROJECT["project"]["dependencies"])}
    assert required - {"sb3-combrel"} <= pins


@pytest.mark.long
def test_importing_the_package_loads_no_extra_and_compiles_nothing():
    code = """
import sys
import numba.core.dispatcher as dispatcher
def no_compiling(*args, **kwargs):
    raise AssertionError("compiled at import")
dispatcher.Dispatcher.compile = no_compiling
import sb3_combrel
sb3_combrel.FittedRMax, sb3_combrel.COMBREL, sb3_combrel.TIMBREL, sb3_combrel.SourceInstances
extras = "mujoco dm_control rl_zoo3 sb3_contrib optuna minari icub_models matplotlib pandas tyro combrel_envs".split()
sys.exit(" ".join(name for name in extras if name in sys.modules) or None)
"""
    run("-c", code)


@pytest.mark.long
def test_a_wheel_is_complete_and_works_where_it_is_installed(tmp_path):
    """With the requirements of this environment; `make smoke` does the same in an empty one."""
    # Built from a copy: setuptools would leave its build folder in the repository.
    listed, copy = set().union(*map(files_on_disk, WHERE)), tmp_path / "copy"
    for original in [
        *(ROOT / name for name in BESIDE),
        *configurations().values(),
        *(WHERE[name.split("/")[0]].parent / name for name in listed),
    ]:
        target = copy / original.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(original.read_bytes())
    built = run("-m", "build", "--no-isolation", "--outdir", copy / "dist", copy)
    assert "absent from the `packages` configuration" not in built.stderr
    (wheel,), (source,) = (copy / "dist").glob("*.whl"), (copy / "dist").glob("*.tar.gz")

    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == {*listed, *configurations()} and f"-{sb3_combrel.__version__}-" in wheel.name
    assert {"sb3_combrel/py.typed", "sb3_combrel/version.txt", "combrel_envs/assets/icub_upper.LICENSE.md"} <= names
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {*BESIDE, "envs/combrel_envs/assets/icub_upper.xml"} <= names
    assert not any(name.startswith("tests") for name in names)
    pytest.importorskip("twine")
    assert run("-m", "twine", "check", "--strict", wheel, source).stdout.count("PASSED") == 2

    site, away = tmp_path / "site", tmp_path / "away"
    away.mkdir()
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", site, wheel)
    environment = {**os.environ, "PYTHONPATH": str(site), "MPLBACKEND": "Agg"}
    done = run("-P", ROOT / "tests/helpers/smoke.py", site, cwd=away, env=environment)
    assert f"sb3_combrel {sb3_combrel.__version__} works" in done.stdout
