"""Compiled functions: how Python calls them, what their first call does, and what the import leaves alone."""

import copy
import gc
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from sb3_combrel.common.compiled import EntryPoint, remove_outdated
from sb3_combrel.common.scaling import StateScaling, scale_into_box


def test_an_entry_point_returns_what_the_function_returns_and_can_be_copied():
    states = np.array([[0.5, 3.0], [-2.0, 1.0]])
    low, ranges, flags = np.array([0.0, 1.0]), np.array([2.0, 4.0]), np.array([False, True])
    scale = EntryPoint(scale_into_box)
    for again in (scale, scale, copy.deepcopy(scale), pickle.loads(pickle.dumps(scale))):
        for call in (again, again.call):
            units, expected = np.empty_like(states), np.empty_like(states)
            assert call(states, low, ranges, flags, units) == scale_into_box(states, low, ranges, flags, expected)
            np.testing.assert_array_equal(units, expected)


def test_scale_into_box_is_to_unit_moved_into_the_box():
    scaling = StateScaling(np.array([-1.0, 0.0, 10.0]), np.array([1.0, 5.0, 11.0]))
    states = np.random.default_rng(0).uniform([-2.0, -1.0, 9.5], [2.0, 6.0, 11.5], (100, 3))
    units = np.empty_like(states)
    low, ranges, flags = scaling.low, scaling.high - scaling.low, np.zeros(3, dtype=bool)
    assert scale_into_box(states, low, ranges, flags, units)
    np.testing.assert_array_equal(units, np.clip(scaling.to_unit(states), 0.0, 1.0))
    inside = scaling.to_raw(np.full((1, 3), 0.5))
    assert not scale_into_box(inside, low, ranges, flags, units[:1])
    assert scale_into_box(np.full((1, 3), np.nan), low, ranges, flags, units[:1])


@pytest.fixture(params=[True, False])
def collecting(request):
    """Garbage collection on and off; on again afterwards."""
    (gc.enable if request.param else gc.disable)()
    yield request.param
    gc.enable()


def test_garbage_collection_waits_during_the_first_call_of_an_entry_point_only(collecting):
    entry = EntryPoint(gc.isenabled)
    assert entry.call() is False
    assert gc.isenabled() == collecting
    assert entry.call() == entry() == collecting


def test_garbage_collection_is_as_before_when_the_function_does_not_compile(collecting):
    entry = EntryPoint(njit(lambda x: x.nothing))
    for _ in range(2):
        with pytest.raises(TypingError, match="nothing"):
            entry.call(1)
        assert gc.isenabled() == collecting


def test_garbage_collection_is_as_before_when_the_function_raises(collecting):
    def fail():
        raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError, match="on purpose"):
        EntryPoint(fail).call()
    assert gc.isenabled() == collecting


MESSAGE = "sb3_combrel: compiling"


def run(code, cache):
    """What a fresh Python process prints to stdout and stderr, with compiled code cached in ``cache``."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


COMPILE_TWO = """
import gc
import numpy as np
from sb3_combrel.common.compiled import EntryPoint, remove_outdated
from sb3_combrel.common.instances import Instances, put_instance_at
from sb3_combrel.common.scaling import scale_into_box

one = np.zeros((1, 1))
EntryPoint(scale_into_box).call(one, np.zeros(1), np.ones(1), np.zeros(1, dtype=bool), one.copy())
EntryPoint(scale_into_box).call(one.astype(np.float32), np.zeros(1), np.ones(1), np.zeros(1, dtype=bool), one.copy())
instances = Instances.empty(1, 1)
put_instance_at.call(instances, (0, 0, np.zeros(1), np.ones(1), -1.0, False))
assert instances.size[0] == 1 and gc.isenabled()
"""


@pytest.mark.integration
def test_compilation_is_announced_once_and_what_is_cached_is_not_announced(tmp_path):
    _, printed = run(COMPILE_TWO, tmp_path)
    assert printed.count(MESSAGE) == 1
    _, printed = run(COMPILE_TWO, tmp_path)
    assert MESSAGE not in printed


OTHER_PEOPLE_S_FUNCTIONS = """
import gc
import threading
import types

import sb3_combrel
from numba import njit
from numba.core import event
from sb3_combrel import COMBREL, FittedRMax
from sb3_combrel.common.compiled import EntryPoint, remove_outdated

def plus(x):
    return x + 1

def without_module():
    function = types.FunctionType(plus.__code__, {})
    function.__module__ = None
    return njit(function)

def of_another_module():
    function = types.FunctionType(plus.__code__, {})
    function.__module__ = "somebody.elses"
    return njit(function)

seen = []

class Listener(event.Listener):
    def on_start(self, event):
        seen.append(gc.isenabled())
    def on_end(self, event):
        pass

with event.install_listener("numba:compile", Listener()):
    for make in (without_module, of_another_module):
        assert make()(1) == 2
    assert seen == [True, True], "garbage is collected as ever"

# Also while a function of the package is compiling, which others may do in another thread, or within it.
def call_others():
    return [make()(1) for make in (without_module, of_another_module)]

assert EntryPoint(call_others).call() == [2, 2]
print("fine")
"""


@pytest.mark.integration
def test_the_import_leaves_the_compilation_of_other_people_s_functions_alone(tmp_path):
    printed, errors = run(OTHER_PEOPLE_S_FUNCTIONS, tmp_path)
    assert printed == "fine\n"
    assert MESSAGE not in errors, "only functions of this package are announced"


def test_compiled_code_older_than_any_source_file_is_removed(tmp_path):
    cache = tmp_path / "room" / "__pycache__"
    cache.mkdir(parents=True)
    for name, age in (("old.f-1.nbi", 100), ("new.f-1.nbi", 0), ("old.f-1.1.nbc", 100), ("a.cpython-311.pyc", 100)):
        (cache / name).touch()
        os.utime(cache / name, (2_000_000_000 - age,) * 2)
    for name, age in (("a.py", 1000), ("room/b.py", 50)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (2_000_000_000 - age,) * 2)
    remove_outdated([tmp_path])
    assert sorted(file.name for file in cache.iterdir()) == ["a.cpython-311.pyc", "new.f-1.nbi", "old.f-1.1.nbc"]


CALLER, CALLED = (
    "from numba import njit\nfrom called import plus\n\n@njit(cache=True)\ndef call(x):\n    return plus(x)\n",
    """
from numba import njit

@njit(cache=True)
def plus(x):
    return x + {}
""",
)


@pytest.mark.integration
@pytest.mark.parametrize("removes", [False, True])
def test_a_function_is_compiled_again_in_numba_cache_dir_when_what_it_calls_has_changed(tmp_path, removes):
    """Numba alone does not notice; that it does not is shown too, so that this is looked at again when it does."""
    room, cache = tmp_path / "room", tmp_path / "cache"
    room.mkdir()
    (room / "caller.py").write_text(CALLER)
    remove = f"from pathlib import Path; remove_outdated([Path({str(room)!r})], {str(cache)!r});" if removes else ""
    code = f"from sb3_combrel.common.compiled import remove_outdated; import sys; sys.path.insert(0, {str(room)!r});"
    code += f"{remove} from caller import call; print(call(1))"
    printed = []
    for added in (1, 2):
        (room / "called.py").write_text(CALLED.format(added))
        printed.append(run(code, cache)[0])
        assert list(cache.glob("room_*/caller.call-*.nbi"))
    assert printed == ["2\n", "3\n" if removes else "2\n"]
