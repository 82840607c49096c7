"""Compiled functions: how Python calls them, what their first call does, and what the import leaves alone."""

import copy
import gc
import os
import pickle
import runpy
import shutil
import subprocess
import sys
import types
import warnings

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import config, njit
from numba.core.errors import TypingError

from sb3_combrel.common import compiled
from sb3_combrel.common.compiled import EntryPoint, remove_outdated
from sb3_combrel.common.instances import BLOCK, Instances
from sb3_combrel.common.kernels import any_periodic, measure_blocks, squared_distance
from sb3_combrel.common.observations import scale_into_box
from sb3_combrel.common.periodic import difference, differences, periodic_flags
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.fitted_rmax.scales import FoundScales

MESSAGE = "sb3_combrel: compiling"
# Learns with and without a source, and prints compiled functions of the package that have a version for a constant.
VERSIONS_FOR_CONSTANTS = """
import sys
from numba.core.dispatcher import Dispatcher
from sb3_combrel import COMBREL, FittedRMax, SourceInstances
source = SourceInstances.record(None, "MountainCar-v0", n_instances=200, seed=0)
for settings in ({}, {"degree": 0}):
    FittedRMax("MountainCar-v0", seed=0, transfer=COMBREL(source), **settings).learn(200)
modules = [module for name, module in sys.modules.items() if name.startswith("sb3_combrel.")]
found = [getattr(value, "function", value) for module in modules for value in vars(module).values()]
compiled = {value for value in found if isinstance(value, Dispatcher) and value.nopython_signatures}
assert len(compiled) > 30, len(compiled)
for each in compiled:
    if any("Literal" in str(argument) for signature in each.nopython_signatures for argument in signature.args):
        print(each.py_func.__name__)
"""


def test_an_entry_point_returns_what_the_function_returns_and_can_be_copied():
    states = np.array([[0.5, 3.0], [-2.0, 1.0]])
    scales = np.array([0.0, 1.0]), np.array([2.0, 4.0]), np.array([False, True]), True, np.empty((0, 2)), np.zeros(3)
    scale = EntryPoint(scale_into_box.function)
    for again in (scale, scale, copy.deepcopy(scale), pickle.loads(pickle.dumps(scale))):
        units, expected = np.empty_like(states), np.empty_like(states)
        assert again.call(states, *scales, units) == scale_into_box.function(states, *scales, expected)
        np.testing.assert_array_equal(units, expected)


def test_scale_into_box_is_to_unit_moved_into_the_box_if_that_is_fixed_and_notes_what_is_observed():
    scaling = StateScaling(np.array([-1.0, 0.0, 10.0]), np.array([1.0, 5.0, 11.0]))
    states = np.random.default_rng(0).uniform([-2.0, -1.0, 9.5], [2.0, 6.0, 11.5], (100, 3))
    units, nothing, n_outside = np.empty_like(states), np.empty((0, 3)), np.zeros(4)
    scales = scaling.low.copy(), scaling.high - scaling.low, np.zeros(3, dtype=bool)
    assert scale_into_box.call(states, *scales, True, nothing, n_outside, units)
    np.testing.assert_array_equal(units, np.clip(scaling.to_unit(states), 0.0, 1.0))
    observed = np.array([[0.0, np.inf, 9.0], [0.0, -np.inf, 9.0]])
    assert scale_into_box.call(states, *scales, False, observed, n_outside, units)
    np.testing.assert_array_equal(units, scaling.to_unit(states))
    least, most = np.minimum(states.min(axis=0), [0.0, np.inf, 9.0]), np.maximum(states.max(axis=0), [0.0, -np.inf, 9.0])
    np.testing.assert_array_equal(observed, [least, most])
    outside = (scaling.to_unit(states) != np.clip(scaling.to_unit(states), 0.0, 1.0)).sum(axis=0)
    np.testing.assert_array_equal(n_outside, [*outside, 100])
    rounded = np.float32([[1.0, 5.0, 11.0]]) * (1.0 + 1e-7)
    assert scale_into_box.call(rounded.astype(np.float64), *scales, True, observed, n_outside, units[:1])
    np.testing.assert_array_equal(n_outside, [*outside, 101])
    assert not scale_into_box.call(scaling.to_raw(np.full((1, 3), 0.5)), *scales, True, nothing, n_outside, units[:1])
    assert scale_into_box.call(np.full((1, 3), np.nan), *scales, True, nothing, n_outside, units[:1])


@pytest.fixture(params=[True, False])
def collecting(request):
    """Garbage collection on and off; on again afterwards."""
    (gc.enable if request.param else gc.disable)()
    yield request.param
    gc.enable()


def test_garbage_collection_waits_during_the_first_call_of_an_entry_point_only(collecting):
    entry = EntryPoint(gc.isenabled)
    assert entry.call() is False and gc.isenabled() == collecting and entry.call() == collecting


def fail(x):
    raise RuntimeError("on purpose")


@pytest.mark.parametrize(("function", "error"), [(njit(lambda x: x.nothing), TypingError), (fail, RuntimeError)])
def test_garbage_collection_is_as_before_when_the_function_raises_or_does_not_compile(collecting, function, error):
    with pytest.raises(error):
        EntryPoint(function).call(1)
    assert gc.isenabled() == collecting


def function_of_module(name):
    function = types.FunctionType((lambda x: x + 1).__code__, {})
    function.__module__ = name
    return njit(function)


def test_compilation_of_functions_of_this_package_alone_is_announced_and_once(capsys, monkeypatch):
    monkeypatch.setattr(compiled._announcement, "printed", False)
    for name in (None, "somebody.elses"):
        assert EntryPoint(function_of_module(name)).call(1) == 2
    assert function_of_module("sb3_combrel.anything")(1) == 2, "not by an entry point"
    assert MESSAGE not in capsys.readouterr().err
    for _ in range(2):
        assert EntryPoint(function_of_module("sb3_combrel.anything")).call(1) == 2
    assert capsys.readouterr().err.count(MESSAGE) == 1


def test_what_is_cached_is_not_announced(capsys, monkeypatch, tmp_path):
    (tmp_path / "loops.py").write_text("from numba import njit\n\n\n@njit(cache=True)\ndef plus(x):\n    return x + 1\n")
    for times in (1, 0):
        monkeypatch.setattr(compiled._announcement, "printed", False)
        assert EntryPoint(runpy.run_path(str(tmp_path / "loops.py"), run_name="sb3_combrel.loops")["plus"]).call(1) == 2
        assert capsys.readouterr().err.count(MESSAGE) == times


def touch(path, age):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    os.utime(path, (2_000_000_000 - age,) * 2)
    return path


def test_compiled_code_older_than_any_source_file_beside_some_is_removed_when_asked_for_and_not_by_the_import(tmp_path):
    rooms = tmp_path / "package" / "planning", tmp_path / "package" / "models"
    touch(rooms[0] / "grid.py", 1000)
    touch(rooms[1] / "lists.py", 50)
    touch(tmp_path / "package" / "experiments" / "has_no_compiled_code.py", 0)
    old = [touch(room / "__pycache__" / "old.f-1.nbi", 100) for room in rooms]
    kept = [touch(rooms[0] / "__pycache__" / name, age) for name, age in (("new.nbi", 10), ("old.nbc", 100), ("a.pyc", 100))]
    (tmp_path / "package" / "common").mkdir()
    module = shutil.copy(compiled.__file__, tmp_path / "package" / "common")
    touch(tmp_path / "package" / "common" / "compiled.py", 100)
    runpy.run_path(module)
    assert all(file.exists() for file in [*old, *kept])
    remove_outdated(tmp_path / "package")
    assert not any(file.exists() for file in old) and all(file.exists() for file in kept)


def test_compiled_code_in_numba_cache_dir_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    folder = njit(cache=True)(scale_into_box.function.py_func).stats.cache_path
    index = touch(tmp_path / folder / "observations.f-1.nbi", 2_000_000_000)
    remove_outdated(compiled.PACKAGE / "common", str(tmp_path))
    assert index.is_relative_to(tmp_path) and not index.exists()


# Periodic variables: differences the short way around, observations that are wrapped, and flags that are refused.
repeatable = settings(deadline=None, derandomize=True, max_examples=30)
coordinates = st.floats(-3.0, 3.0)
ANGLE_AND_SPEED = StateScaling([-np.pi, -8.0], [np.pi, 8.0])


@njit
def difference_of(a, b, periodic):
    return difference(a, b, periodic)


@njit
def squared_distance_of(a, b, periodic):
    return squared_distance(a, b, periodic, any_periodic(periodic))


@repeatable
@given(coordinates, coordinates)
def test_a_difference_goes_the_short_way_around_a_period_of_1(a, b):
    found = difference_of(a, b, True)
    assert -0.5 - 1e-12 <= found <= 0.5
    assert abs(found - (a - b) - np.rint(found - (a - b))) < 1e-12, "whole periods are left out, nothing else"
    assert difference_of(a, b, False) == a - b
    assert differences(np.array([a, a]), np.array([b, b]), np.array([True, False])).tolist() == [found, a - b]


def test_half_a_period_apart_and_tiny_differences():
    assert difference_of(0.75, 0.25, True) == difference_of(0.25, 0.75, True) == -0.5
    assert difference_of(0.3 - 1e-17, 0.3, True) == (0.3 - 1e-17) - 0.3
    assert difference_of(0.0, 1e-20, True) == -1e-20, "no digits are lost"


@repeatable
@given(st.integers(0, 10**6), st.integers(1, 3))
def test_no_instance_is_nearer_than_the_box_of_its_block(seed, d):
    rng = np.random.default_rng(seed)
    periodic, n_blocks = rng.random(d) < 0.7, 4
    states = rng.uniform(0.0, 1.0, d) + rng.normal(0.0, 0.3, (n_blocks, BLOCK, d))
    states = np.where(periodic, states % 1.0, states)
    low, high = (edge(states, axis=1).T for edge in (np.min, np.max))
    n = n_blocks * BLOCK
    rows = np.zeros(n, dtype=np.int64), states.reshape(n, d), np.zeros((n, d)), np.zeros(n), np.zeros(n, dtype=np.bool_)
    instances = Instances.of_rows(1, *rows, periodic)
    for state in rng.uniform(-1.0, 2.0, (5, d)):
        assert measure_blocks(instances, 0, state) == n_blocks
        for block in range(n_blocks):
            # The box, point by point along each variable: the sum of the least squares is its distance.
            apart = []
            for k in range(d):
                inside = np.linspace(low[k, block], high[k, block], 501)
                turns = range(-3, 4) if periodic[k] else (0,)
                apart.append(min(np.abs(state[k] - inside - turn).min() for turn in turns))
            assert instances.gap[block] == pytest.approx(np.square(apart).sum(), abs=5e-3)
            nearest = min(squared_distance_of(state, one, periodic) for one in states[block])
            assert instances.gap[block] <= nearest + 1e-12


@repeatable
@given(st.floats(-50.0, 50.0), st.integers(-3, 3))
def test_an_angle_is_wrapped_without_a_warning(angle, turns):
    scale = FoundScales(spaces.Box(-9.0, 9.0, (2,)), (ANGLE_AND_SPEED.low, ANGLE_AND_SPEED.high), [True, False]).to_unit
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        unit = scale(np.array([angle + 2 * np.pi * turns, 0.0]))
    assert 0.0 <= unit[0] <= 1.0 and unit[1] == 0.5
    assert np.cos(ANGLE_AND_SPEED.to_raw(unit)[0]) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(ANGLE_AND_SPEED.to_raw(unit)[0]) == pytest.approx(np.sin(angle), abs=1e-9)


def test_what_is_not_periodic_is_moved_to_the_boundary_with_a_warning_and_what_is_not_finite_is_refused():
    scale = FoundScales(spaces.Box(-9.0, 9.0, (2,)), (ANGLE_AND_SPEED.low, ANGLE_AND_SPEED.high), [True, False]).to_unit
    with pytest.warns(UserWarning, match="outside the bounds"):
        np.testing.assert_allclose(scale(np.array([[1.5 * np.pi, 9.0]])), [[0.25, 1.0]])
    for wrong in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="an observation must be finite, got"):
            scale(np.array([wrong, 0.0]))


@pytest.mark.parametrize("flags", [True, [True], [True, False, True], [1, 0], "TF", [None, True], np.array([0.0, 1.0])])
def test_wrong_flags_are_named_with_their_value(flags):
    with pytest.raises(ValueError, match="periodic must be None or 2 booleans") as caught:
        periodic_flags(flags, 2)
    assert repr(flags) in str(caught.value)


def test_flags_come_as_a_sequence_an_array_or_none():
    assert periodic_flags(None, 2) == (False, False)
    assert periodic_flags((True, False), 2) == periodic_flags(np.array([True, False]), 2) == (True, False)


@pytest.mark.long
def test_no_function_is_compiled_once_more_for_a_constant(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", VERSIONS_FOR_CONSTANTS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr
