"""``compare(output=folder)``: finished runs are kept, the same call goes on from them, and what would be mixed is refused."""

import importlib
import json
import linecache
import os
import subprocess
import sys
import types
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers.dashboard import NamedWalk
from helpers.own_method import Mine
from helpers.walk import Walk, walk_source

from sb3_combrel import COMBREL, FittedRMax, MappingSet, SourceInstances
from sb3_combrel.common.files import write_whole
from sb3_combrel.comparison import compare as module
from sb3_combrel.comparison.compare import ComparedRun, compare
from sb3_combrel.comparison.controls import CONTROL
from sb3_combrel.runs.described import described
from sb3_combrel.runs.runner import FOLDER, Backend, JobError, run_missing

METHODS = {"none": None, "COMBREL": COMBREL(walk_source(), use="instances")}
CALL = dict(env=Walk, methods=METHODS, seeds=1, steps=60, model_breadth=0.15, resolution=3, degree=0)
POLE = dict(env="CartPole-v1", methods={"none": None, "other": None}, baseline="none")


def quietly(**change):
    """Compare; warnings of few runs do not matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return compare(**{**CALL, **change})


@pytest.fixture
def carried_out(monkeypatch):
    """Method and seed of each run that is carried out."""
    found, carry_out = [], ComparedRun.carry_out

    def noted(self):
        found.append((self.method, self.seed))
        return carry_out(self)

    monkeypatch.setattr(ComparedRun, "carry_out", noted)
    return found


def files_of(output):
    return sorted((output / FOLDER).glob("*.json"))


def test_a_comparison_that_goes_on_has_the_same_page_as_one_in_one_go(carried_out, tmp_path):
    source = SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)
    call = dict(env=NamedWalk, methods={"none": None, "COMBREL": COMBREL(source)}, seeds=2, steps=250, degree=1)
    output = tmp_path / "kept"
    plain = quietly(**call)
    carried_out.clear()
    quietly(**call, output=output)
    assert len(carried_out) == len(files_of(output)) == 6
    carried_out.clear()
    again = quietly(**call, output=str(output))
    assert not carried_out
    # As after a kill: two runs are missing, and of a third there is half a file, which a crash of the machine may leave.
    lost, cut, also_lost = files_of(output)[::2]
    lost.unlink()
    also_lost.unlink()
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    resumed = quietly(**call, output=output)
    assert len(carried_out) == 3
    pages = [found.save(tmp_path / "report.html").read_bytes() for found in (plain, resumed)]
    assert pages[0] == pages[1] and str(again) == str(plain)
    assert repr(again.reports) == repr(plain.reports) and again.reports["COMBREL"][0].history
    for method, shown in plain.snapshots.items():
        for name in ("values", "greedy", "bound"):
            np.testing.assert_array_equal(getattr(again.snapshots[method], name), getattr(shown, name), strict=True)


def test_more_seeds_and_methods_use_what_is_there(carried_out, tmp_path):
    quietly(output=tmp_path, methods={"none": None, "None": None}, baseline="none")
    carried_out.clear()
    quietly(output=tmp_path, seeds=2, methods={"none": None, "None": None, "more": None}, baseline="none", threshold=-10)
    assert carried_out == [("none", 1), ("None", 1), ("more", 0), ("more", 1)]
    # The page needs more of the first run than there is.
    carried_out.clear()
    quietly(output=tmp_path, seeds=[1], methods={"none": None, "more": None}, baseline="none")
    assert carried_out == [("none", 1), ("more", 1)]


def test_a_method_before_the_others_may_change_the_control(carried_out, tmp_path):
    """It is the first method's that chooses a mapping; with the others alone the control that was is still there."""
    more = {"none": None, "onto": COMBREL(walk_source(), "surjective", use="instances"), **METHODS}
    for methods, made in ((METHODS, ["none", "COMBREL", CONTROL]), (more, ["onto", CONTROL]), (METHODS, [])):
        carried_out.clear()
        found = quietly(output=tmp_path, methods=methods)
        assert list(found.curves) == [*methods, CONTROL] and [name for name, _ in carried_out] == made


def test_files_have_names_that_are_safe_and_differ():
    alike, long = ["none", "None", "no ne", "no/ne", "../none"], ["a" * 300, "a" * 299 + "b", "移" * 300]
    methods = [*alike, *long, "", 'n"<one>:*?|\\', "nul\0"]
    runs = [ComparedRun(group="", method=method, seed=0, env="CartPole-v1") for method in methods]
    names = [replace(run, is_shown=is_shown).name for run in runs for is_shown in (False, True)]
    assert len({name.lower() for name in names}) == 2 * len(methods)
    for name in names:
        assert Path(name).name == name and not set(name) & set('/\\"<>:*?|\0 ')
        assert len(f"{name}.json12345678.part".encode()) < 255


def tasks(noise):
    """A task whose function has no name and holds a number."""
    return lambda: Walk(limit=noise)


def sets(*states):
    mappings = MappingSet([[0, 1], list(states)], [[0, 1]])
    return {"none": None, "x": COMBREL(walk_source(), mappings, use="instances")}


def with_combrel(source=None, **arguments):
    return dict(methods={"none": None, "COMBREL": COMBREL(source or walk_source(), use="instances", **arguments)})


@pytest.mark.parametrize(
    ("before", "now", "message"),
    [
        ({}, dict(steps=61), r"\(none, seed 0: n_steps was 60 and is 61\)"),
        (
            {},
            dict(resolution=4, gamma=0.9),
            r"learner.resolution was 3 and is 4; learner.gamma was '\(not given\)' and is 0.9",
        ),
        ({}, dict(env=NamedWalk), r"env was 'helpers.walk.Walk \w{8}' and is 'helpers.dashboard.NamedWalk \w{8}'"),
        (dict(env=tasks(20)), dict(env=tasks(30)), r"env\.\S*lambda> \w{8}\.noise was 20 and is 30"),
        (
            {"instances": walk_source(60)},
            {"instances": walk_source(61)},
            "learner.instances was '60 instances .*' and is '61 instances ",
        ),
        ({}, with_combrel(breadth=0.4), r"\(COMBREL, seed 0: transfer\.\S*COMBREL.breadth was .* and is 0.4\)"),
        ({}, with_combrel(walk_source(61)), "source was '60 instances .* and is '61 instances "),
        (dict(methods=sets(1, 0)), dict(methods=sets(1, 1)), "transfer.mappings was '<2 mappings.* and is '<2 mappings"),
        (POLE, {**POLE, "env": "CartPole-v0"}, "env.id was 'CartPole-v1' and is 'CartPole-v0'"),
    ],
)
def test_runs_of_other_settings_are_refused_and_stay(before, now, message, carried_out, tmp_path):
    quietly(**before, controls=False, output=tmp_path)
    kept = {file: file.read_bytes() for file in files_of(tmp_path)}
    carried_out.clear()
    with pytest.raises(ValueError, match=f"^{tmp_path} has results of other settings .*{message}.*; use another folder by"):
        quietly(**{**before, **now}, controls=False, output=tmp_path)
    assert not carried_out and {file: file.read_bytes() for file in files_of(tmp_path)} == kept


def test_a_source_named_by_its_file_is_known_by_its_content(tmp_path):
    def methods(n):
        walk_source(n).save(tmp_path / "source.npz")
        return {"none": None, "COMBREL": COMBREL(str(tmp_path / "source.npz"), use="instances")}

    quietly(methods=methods(60), output=tmp_path / "kept", controls=False)
    quietly(methods=methods(60), output=tmp_path / "kept", controls=False)
    with pytest.raises(ValueError, match=r"source was '60 instances .*' and is '70 instances "):
        quietly(methods=methods(70), output=tmp_path / "kept", controls=False)


def test_past_data_are_known_by_their_content(tmp_path):
    def settings_of(given):
        run = ComparedRun(group="", method="m", seed=0, env=Walk, learner={"instances": given, "gamma": 0.9})
        return json.loads(json.dumps(run.settings()))["learner"]

    few, many = walk_source(300), replace(walk_source(300), rewards=np.arange(300) / 1e12)
    for kind in ("npz", "csv"):
        found = []
        for source in (few, few, many):
            source.save(tmp_path / "log.npz") if kind == "npz" else source.to_table().to_csv(tmp_path / "log.csv")
            found.append(settings_of(tmp_path / ("log" if kind == "npz" else "log.csv")))
        assert found[0] == found[1] != found[2]
    assert settings_of(few.to_table()) == settings_of(few.to_table()) != settings_of(many.to_table())
    assert settings_of("a/minari-dataset-v0") == {"instances": "a/minari-dataset-v0", "gamma": 0.9}
    model = FittedRMax(Walk(), seed=0, instances=few, resolution=3, degree=0)
    assert settings_of(model) == settings_of(model.source_instances())
    changes = dict(low=few.low - 1, high=few.high + 1, n_actions=3, state_names=("x", "y"), periodic=(True, False))
    others = [described(replace(few, **({"action_names": ()} | {name: value}))) for name, value in changes.items()]
    assert len({described(few), *others}) == 6 and described(replace(few, origin={"env": "other"})) == described(few)


def test_settings_do_not_depend_on_where_things_lie_in_memory():
    class Odd:
        def __repr__(self):
            return f"Odd({object.__repr__(self)})"

    one, other = (
        ComparedRun(group="", method="m", seed=0, env=gym.envs.registration.EnvSpec("Odd-v0", Walk, kwargs={"odd": Odd()}))
        for _ in range(2)
    )
    assert described([np.random.default_rng(0), {"b", "a"}]) == ["Generator(PCG64)", str(["'a'", "'b'"])]
    settings = json.dumps(one.settings())
    assert settings == json.dumps(other.settings()) and " at 0x" not in settings and "helpers.walk.Walk" in settings
    assert " at 0x" not in str(described(lambda: [each for each in (lambda: 3)()]))


LIMIT = 0


class Maker:
    """Makes a task from an attribute; it knows itself, as an object may."""

    def __init__(self, limit):
        self.limit, self.own = limit, [self]

    def __call__(self):
        return Walk(limit=self.limit)


@dataclass
class Settings:
    """An object whose repr leaves numbers out."""

    limits: np.ndarray


def enclosed(limit):
    def make():
        return Walk(limit=limit)

    return make


def with_global(limit, monkeypatch, make):
    monkeypatch.setattr(sys.modules[__name__], "LIMIT", limit)
    return described(make)


def test_what_a_function_holds_tells_it_from_others(monkeypatch):
    def of_global():
        return [Walk(limit=LIMIT) for _ in range(1)]

    def with_default(limit):
        def make(limit=limit):
            return Walk(limit=limit)

        return make

    def settings(limit):
        return Settings(np.where(np.arange(3000) == 1500, limit + 1e-12, 0.0))

    for made in (enclosed, tasks, Maker, lambda limit: Maker(limit).__call__, with_default, settings):
        assert described(made(3)) == described(made(3)) != described(made(4))
    for make in (of_global, lambda: Walk(limit=LIMIT)):
        assert with_global(3, monkeypatch, make) == with_global(3, monkeypatch, make) != with_global(4, monkeypatch, make)
    assert described(lambda a, b: a + b) != described(lambda a, b: a - b)
    assert described(Walk(limit=3)) == described(Walk(limit=4)), "the attributes of an environment change as runs go on"


def test_values_are_described_as_they_were_before_the_first_run(carried_out, tmp_path):
    """A function may count what it makes; the same script, begun again, does so again."""

    def counted():
        made = []

        def make():
            made.append(0)
            return Walk()

        return make

    for n_carried_out in (2, 0):
        carried_out.clear()
        quietly(env=counted(), output=tmp_path, controls=False)
        assert len(carried_out) == n_carried_out


def test_an_edited_environment_is_another(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)

    def settings_of(step):
        (tmp_path / "edited_walk.py").write_text(
            f"from helpers.walk import Walk\n\nclass Mine(Walk):\n    step_size = {step}\n"
        )
        monkeypatch.delitem(sys.modules, "edited_walk", raising=False)
        linecache.clearcache()
        importlib.invalidate_caches()
        made = importlib.import_module("edited_walk").Mine
        by_name = gym.envs.registration.EnvSpec("Mine-v0", "edited_walk:Mine")
        return [described(made), described(by_name)["entry_point"]]

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    one, again, other = settings_of(1), settings_of(1), settings_of(22)
    assert one == again and one[0] == one[1] and one[0] != other[0] and one[1] != other[1]
    assert described(ComparedRun) == "sb3_combrel.comparison.compare.ComparedRun", "the version tells"


def test_an_edited_base_class_makes_another_environment(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_base.py").write_text("class Base:\n    step_size = 1\n")
    (tmp_path / "own_walk.py").write_text("from own_base import Base\n\nclass Mine(Base):\n    pass\n")
    one = importlib.import_module("own_walk").Mine
    before = described(one)
    assert described(one) == before
    (tmp_path / "own_base.py").write_text("class Base:\n    step_size = 22\n")
    linecache.clearcache()
    assert described(one) != before


class Slippery(Walk):
    """The walk, as a class of its own."""


class Padded(gym.Wrapper):
    """A wrapper that changes nothing."""


@pytest.mark.parametrize("change", [Slippery, lambda: Padded(Walk())])
def test_the_class_of_an_environment_that_a_function_makes_tells_runs_apart(change, carried_out, tmp_path):
    made = [Walk]

    def make():
        return made[0]()

    quietly(env=make, output=tmp_path)
    carried_out.clear()
    quietly(env=make, output=tmp_path)
    assert not carried_out
    made[0] = change
    with pytest.raises(ValueError, match="classes"):
        quietly(env=make, output=tmp_path)
    assert not carried_out


TYPED_IN = """
import abc

class Mine(abc.ABC):
    step_size = {step}

    def reset(self):
        return self.step_size in {{"one", "two", "three"}}

    @staticmethod
    def step(action):
        return [each {sign} action for each in (1, 2)]

    @property
    def far(self):
        return {far}

def make(limit={limit}):
    return Mine()
"""


def typed_in(step=1, sign="+", far=5, limit=9):
    """A class and a function without a source, as in a notebook."""
    module = types.ModuleType("notebook")
    exec(TYPED_IN.format(step=step, sign=sign, far=far, limit=limit), module.__dict__)
    return module.Mine, module.make


def test_what_is_typed_in_is_known_by_its_code(monkeypatch):
    described_as = [described(each) for each in typed_in()]
    assert described_as == [described(each) for each in typed_in()]
    for change in (dict(step=2), dict(sign="-"), dict(far=6)):
        assert described(typed_in(**change)[0]) != described_as[0], change
    assert described(typed_in(limit=8)[1]) != described_as[1]
    assert (
        described(np.add.reduce).endswith(".reduce") and described(len) == "builtins.len"
    ), "compiled code has none to digest"
    code = f"import sys; sys.path[:] = {sys.path}; from {__name__} import *; print(json.dumps([*map(described, typed_in())]))"
    for seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        call = [sys.executable, "-c", code]
        made = subprocess.run(call, env=environment, capture_output=True, text=True, check=True)
        assert json.loads(made.stdout) == described_as


class Unsaid(Mine):
    """Keeps its argument under another name."""

    def __init__(self, worth):
        super().__init__(worth)


def test_a_method_that_does_not_say_its_arguments_is_not_kept(carried_out, tmp_path):
    call = dict(methods={"none": None, "mine": Unsaid(-2.0)}, controls=False)
    quietly(**call)
    carried_out.clear()
    message = (
        r"^mine: runs of Unsaid with other arguments cannot be told apart \(.*worth.*\): give it the method arguments\(\)"
    )
    with pytest.raises(ValueError, match=message):
        quietly(**call, output=tmp_path)
    assert not carried_out


@pytest.mark.parametrize("kind", ["file", "below a file", "number", "others"])
def test_an_output_that_cannot_be_one_is_refused_before_anything_is_tried_out(kind, tmp_path, monkeypatch):
    (tmp_path / "thesis.txt").write_text("mine")
    wrong = {"file": tmp_path / "thesis.txt", "below a file": tmp_path / "thesis.txt" / "x", "number": 3, "others": tmp_path}[
        kind
    ]
    monkeypatch.setattr(module, "_try_out", lambda run: pytest.fail("the error should have come before"))
    message = {
        "number": "output must be the path of a folder, or None, got 3",
        "others": "has files that are not",
    }
    with pytest.raises(
        (ValueError, OSError), match=message.get(kind, "^output must be in a folder that can be written to, got .*")
    ):
        quietly(output=wrong)
    assert os.listdir(tmp_path) == ["thesis.txt"] and (tmp_path / "thesis.txt").read_text() == "mine"


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions are those of POSIX")
@pytest.mark.parametrize("rights", [0o000, 0o500])
def test_a_folder_without_permission_is_named(rights, tmp_path):
    output = tmp_path / "kept"
    output.mkdir()
    output.chmod(rights)
    is_root = os.geteuid() == 0
    if is_root:  # who may write anywhere
        os.seteuid(65534)
    try:
        with pytest.raises(
            PermissionError, match=r"^output must be in a folder that can be written to, got .*Permission denied$"
        ):
            quietly(output=output)
    finally:
        if is_root:
            os.seteuid(0)
        output.chmod(0o700)
    assert not any(output.iterdir())


def test_a_disk_that_is_full_loses_no_finished_run(carried_out, tmp_path, monkeypatch):
    n_written = []

    def write_two(target, content):
        n_written.append(target)
        if len(n_written) > 2:
            raise OSError(28, "No space left on device", str(target))
        write_whole(target, content)

    with monkeypatch.context() as patch:
        patch.setattr("sb3_combrel.runs.runner.write_whole", write_two)
        with pytest.raises(
            OSError, match=r"^output must be .*: No space left on device \(COMBREL, seed 0\); runs that .* kept"
        ):
            quietly(output=tmp_path, seeds=2)
    assert len(carried_out) == 3 and len(files_of(tmp_path)) == 2
    carried_out.clear()
    quietly(output=tmp_path, seeds=2)
    assert carried_out[0] == ("COMBREL", 0) and len(carried_out) == 4


def test_a_report_that_cannot_be_kept_says_so(monkeypatch, tmp_path):
    """Of a method of the user's own, which may report anything; without a folder it is handed on."""
    monkeypatch.setattr(ComparedRun, "measure", lambda *_: {"report": {"odd": object()}})
    run = ComparedRun(group="", method="Mine", seed=0, env=Walk, n_steps=30)
    assert run_missing([run], backend=Backend(n_jobs=1))[0].error == ""
    with pytest.raises(TypeError, match=r"Mine, seed 0: cannot write <object object .*> as plain data"):
        run_missing([run], tmp_path, Backend(n_jobs=1))
    assert "odd" in quietly().reports["COMBREL"][0]


@pytest.mark.parametrize("how", ["stopped", "no episode", "failed"])
def test_without_a_folder_finished_runs_are_lost_neither(carried_out, monkeypatch, tmp_path, how):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    carry_out = ComparedRun.carry_out

    def break_down(run):
        if run.method != CONTROL and run.seed == 0:
            return carry_out(run)
        if how == "no episode":
            return replace(carry_out(run), steps=[])
        raise KeyboardInterrupt if how == "stopped" else RuntimeError("simulator lost")

    with monkeypatch.context() as patch:
        patch.setattr(ComparedRun, "carry_out", break_down)
        with pytest.raises((KeyboardInterrupt, ValueError, JobError)) as caught:
            quietly(seeds=2)
    (folder,) = tmp_path.glob("sb3_combrel_*")
    assert caught.value.__notes__ == [f"Finished runs are kept: the same call with output={str(folder)!r} goes on from them."]
    carried_out.clear()
    quietly(seeds=1, controls=False, output=folder)
    done = [("COMBREL", 0)] if how == "stopped" else []
    assert carried_out == done, "but those that came after"


def test_the_temporary_folder_does_not_stay(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    quietly()
    with monkeypatch.context() as patch:
        patch.setattr(ComparedRun, "carry_out", lambda run: 1 / 0)
        with pytest.raises(JobError) as caught:
            quietly()
    assert not any(tmp_path.glob("sb3_combrel_*")) and not hasattr(caught.value, "__notes__")


def test_a_run_without_an_episode_does_not_lose_the_others(carried_out, tmp_path, monkeypatch):
    carry_out = ComparedRun.carry_out
    monkeypatch.setattr(ComparedRun, "carry_out", lambda run: replace(carry_out(run), **({"steps": []} if run.seed else {})))
    call = dict(output=tmp_path, controls=False)
    with pytest.raises(ValueError, match=r"run of none, seed 1; COMBREL, seed 1; .* seeds=\[0\] compares .* are kept in"):
        quietly(**call, seeds=2)
    carried_out.clear()
    assert quietly(**call, seeds=[0]).n_steps > 0 and not carried_out
