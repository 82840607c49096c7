"""What a user installs: the wheel's contents, its metadata, and what importing the package costs."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

import sb3_combrel

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
WHERE = {"sb3_combrel": ROOT / "sb3_combrel", "combrel_envs": ROOT / "envs" / "combrel_envs"}
BESIDE = ["CHANGELOG.md", "CITATION.cff", "MANIFEST.in", "constraints.txt"]
DATA = {"py.typed", "version.txt", "*.xml", "*.yml", "*.png", "*.LICENSE.md"}


def files_on_disk(package):
    """The files of a package that belong into a wheel, by their path in it."""
    return {
        f"{package}/{path.relative_to(WHERE[package]).as_posix()}"
        for path in WHERE[package].rglob("*")
        if path.suffix == ".py" or any(path.match(pattern) for pattern in DATA)
    }


def metadata_of(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        return archive.read(name).decode()


def run_python(code, *options):
    done = subprocess.run([sys.executable, *options, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """A folder with the source distribution, and the wheel that is built from it."""
    # Built from a copy: setuptools would leave its build folder in the repository.
    copy = tmp_path_factory.mktemp("source")
    listed = [*BESIDE, "LICENSE", "README.md", "pyproject.toml", *sorted(set().union(*map(files_on_disk, WHERE)))]
    for name in listed:
        package, _, rest = name.partition("/")
        original = WHERE[package] / rest if rest else ROOT / name
        target = copy / original.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(original.read_bytes())
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", copy / "dist", copy]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "absent from the `packages` configuration" not in done.stderr
    return copy / "dist"


@pytest.fixture(scope="module")
def wheel(dist):
    (built,) = dist.glob("*.whl")
    return built


def test_every_package_on_disk_is_listed():
    on_disk = {
        ".".join(Path(name).parent.parts)
        for package in WHERE
        for name in files_on_disk(package)
        if name.endswith("__init__.py")
    }
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == on_disk


def test_every_folder_with_modules_is_a_package():
    for package, folder in WHERE.items():
        for module in folder.rglob("*.py"):
            assert (module.parent / "__init__.py").exists(), f"{package}: {module.parent} has no __init__.py"


@pytest.mark.integration
def test_the_wheel_contains_both_packages_with_their_data(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == files_on_disk("sb3_combrel") | files_on_disk("combrel_envs")
    assert {"sb3_combrel/py.typed", "combrel_envs/py.typed", "sb3_combrel/version.txt"} <= names
    assert "combrel_envs/assets/mountain_car_4d.xml" in names
    assert {"combrel_envs/assets/icub_upper.xml", "combrel_envs/assets/icub_upper.LICENSE.md"} <= names


@pytest.mark.integration
def test_the_source_distribution_has_what_belongs_to_it_and_no_half_of_the_tests(dist):
    (built,) = dist.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {*BESIDE, "LICENSE", "README.md", "pyproject.toml", "envs/combrel_envs/assets/icub_upper.xml"} <= names
    assert not [name for name in names if name.startswith("tests")]


@pytest.mark.integration
def test_the_metadata_are_fit_for_an_index(dist):
    pytest.importorskip("twine")
    command = [sys.executable, "-m", "twine", "check", "--strict", *map(str, dist.iterdir())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.count("PASSED") == 2, done.stdout + done.stderr


@pytest.mark.integration
def test_the_wheel_works_where_it_is_installed(wheel, tmp_path):
    """With the requirements of this environment; `make smoke` does the same in an empty one."""
    site, away = tmp_path / "site", tmp_path / "away"
    away.mkdir()
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target", site, wheel]
    done = subprocess.run(install, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    environment = {**os.environ, "PYTHONPATH": str(site), "MPLBACKEND": "Agg"}
    command = [sys.executable, "-P", ROOT / "tests/helpers/smoke.py", site]
    done = subprocess.run(command, cwd=away, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"sb3_combrel {sb3_combrel.__version__} works" in done.stdout


@pytest.mark.integration
def test_versions_agree(wheel):
    assert re.fullmatch(r"\d+\.\d+\.\d+\w*", sb3_combrel.__version__)
    assert f"-{sb3_combrel.__version__}-" in wheel.name
    assert f"\nVersion: {sb3_combrel.__version__}\n" in metadata_of(wheel)
    assert f"version: {sb3_combrel.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{sb3_combrel.__version__}] - 20" in (ROOT / "CHANGELOG.md").read_text()


def test_the_command_is_installed():
    (command,) = metadata.entry_points(group="console_scripts", name="sb3-combrel")
    assert command.value == "sb3_combrel.cli:main"


def test_the_extras_are_those_of_the_documentation():
    assert set(PROJECT["project"]["optional-dependencies"]) == {
        *("envs", "icub", "minari", "zoo", "experiments", "tutorials", "ray", "dask", "docs", "dev", "all"),
    }


def test_all_contains_every_extra_but_those_of_developers():
    extras = PROJECT["project"]["optional-dependencies"]
    (line,) = extras["all"]
    named = set(re.fullmatch(r"sb3-combrel\[(.+)\]", line)[1].split(","))
    assert named == set(extras) - {"all", "dev", "docs"}


def test_constraints_pin_all_that_is_required():
    pins = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")
    )
    pinned = {normal(name) for name in pins}
    extras = PROJECT["project"]["optional-dependencies"].values()
    required = {normal(re.match(r"[\w.-]+", line)[0]) for line in sum(extras, PROJECT["project"]["dependencies"])}
    assert required - {"sb3-combrel"} <= pinned
    assert pins["torch"] == "2.13.0"
    assert pins["mujoco"] == "3.17.0"


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.integration
class TestImport:
    def test_it_works_without_mujoco_and_without_the_zoo(self):
        code = """
import sys
for name in ("mujoco", "dm_control", "rl_zoo3", "sb3_contrib", "minari", "icub_models", "matplotlib", "pandas", "tyro"):
    sys.modules[name] = None
import sb3_combrel
sb3_combrel.FittedRMax, sb3_combrel.COMBREL, sb3_combrel.TIMBREL, sb3_combrel.SourceInstances
"""
        run_python(code)

    def test_it_loads_none_of_the_heavy_extras(self):
        code = "import sys, sb3_combrel; print(*sys.modules)"
        loaded = set(run_python(code).split())
        assert not loaded & {"mujoco", "dm_control", "rl_zoo3", "minari", "combrel_envs", "tyro", "joblib.externals.loky"}

    def test_it_compiles_nothing(self):
        code = """
import numba.core.dispatcher as dispatcher
def no_compiling(*args, **kwargs):
    raise AssertionError("compiled at import")
dispatcher.Dispatcher.compile = no_compiling
import sb3_combrel
"""
        run_python(code)
