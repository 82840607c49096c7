"""What holds of every transfer method: its seed decides, it is saved and restored, it learns, bad arguments are refused."""

import copy

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs
from helpers.own_method import Mine
from helpers.walk import Walk, same_parameters, small, walk_source
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import (
    COMBREL,
    MASTER,
    TIMBREL,
    FactoredMapping,
    FittedRMax,
    InterTaskMapping,
    MappingExperts,
    MappingSet,
    SampleTransfer,
    SoftHomomorphism,
    SparseCodingMapping,
    ThreeWayRBM,
)
from sb3_combrel.transfer.methods import soft_mapping

SOURCE = naive.random_source(np.random.default_rng(0), 80, 2, 2)
OTHER_SOURCE = naive.random_source(np.random.default_rng(1), 50, 1, 3)
ONE = InterTaskMapping([0, None, 1], [1, 0])
OTHER = InterTaskMapping([None, 1, 0], [0, 0], [1, -1, 1])
BANDWIDTHS = {"bandwidths": (0.1, 0.1, 1.0)}
SAMPLES = {"n_random_steps": 20, "n_source_samples": 40}
FEW = {SparseCodingMapping: {"n_atoms": 8}, ThreeWayRBM: {"n_updates": 30, "n_hidden": 4, "n_factors": 4}}
VARIANTS = {
    "TIMBREL": lambda: TIMBREL(SOURCE, [ONE, OTHER], transfer_terminals=False),
    "TIMBREL-pool": lambda: TIMBREL(SOURCE, "pool", mappings="all", relevance=True, relevance_fraction=0.3, **BANDWIDTHS),
    "TIMBREL-prior": lambda: TIMBREL(SOURCE, ONE, use="prior", source_breadth=0.3),
    "COMBREL": lambda: COMBREL([SOURCE, OTHER_SOURCE]),
    "COMBREL-balanced": lambda: COMBREL(SOURCE, "balanced", breadth=0.2, breadth_decay=1.0, transfer_terminals=False),
    "COMBREL-drawn": lambda: COMBREL(SOURCE, "surjective", choice="drawn", neighbor_radius=0.5, max_transitions=30),
    "COMBREL-whole": lambda: COMBREL(SOURCE, [ONE, OTHER], neighbors="state_action", measured="first_episode"),
    "COMBREL-relevance": lambda: COMBREL(SOURCE, relevance=True, relevance_fraction=0.3, measured="first_episode"),
    "COMBREL-near": lambda: COMBREL(SOURCE, "signed_injective", relevance="near", n_neighbors=10, **BANDWIDTHS),
    "COMBREL-prior": lambda: COMBREL(SOURCE, "injective", use="prior", max_transitions=40),
    "COMBREL-factored": lambda: COMBREL([OTHER_SOURCE, SOURCE], "factored", max_transitions=30),
    "TIMBREL-factored": lambda: TIMBREL(OTHER_SOURCE, "random", mappings="signed_factored", use="prior"),
    "COMBREL.paper": lambda: COMBREL.paper(SOURCE),
    "MASTER": lambda: MASTER([SOURCE, OTHER_SOURCE], n_random_steps=20, use="instances"),
    "MASTER-prior": lambda: MASTER(SOURCE, n_random_steps=20, use="prior"),
    "MappingExperts": lambda: MappingExperts([SOURCE, OTHER_SOURCE], "all", max_experts=4, exploration=0.4, gamma=0.9),
    "SampleTransfer": lambda: SampleTransfer([SOURCE, OTHER_SOURCE], n_instances=60, min_transitions=20),
    "SampleTransfer-near": lambda: SampleTransfer(SOURCE, min_transitions=20, max_transitions=30, relevance="near"),
    "SoftHomomorphism": lambda: SoftHomomorphism(OTHER_SOURCE, n_copies=2, n_starts=2, max_transitions=40),
    **{kind.__name__: lambda kind=kind: kind(SOURCE, **SAMPLES, **FEW[kind]) for kind in FEW},
}
#: With the rest nothing is random.
RANDOM = ("COMBREL-drawn", "MappingExperts", "SampleTransfer", "SoftHomomorphism", "SparseCodingMapping", "ThreeWayRBM")
TASK = naive.target_task(np.random.default_rng(5).random((12, 3)), 2)


@pytest.fixture(autouse=True)
def quick_fits(monkeypatch):
    monkeypatch.setattr(soft_mapping, "N_STEPS", 20)


def live(method, first, last):
    """Have it take part in transitions ``first`` to ``last``; what it answered."""
    said = []
    for i in range(first, last):
        state, action, reward, after = naive.random_transition(np.random.default_rng(i), 3, 2)
        decided = method.action(state)
        said.append([-1.0 if decided is None else decided])
        found = method.transferred(np.tile(state, (2, 1)), np.arange(2), np.zeros(2))
        method.note_use(found)
        said += [array[row, :n] for row, n in enumerate(found.length[:2]) for array in found[1:]]
        method.observe(state, action, reward, after, False)
        if i % 10 == 9:
            method.end_episode(i % 20 == 9)
        changed_pairs(method)
    if method.use == "prior":
        said += method.prior(TASK.sample_states, np.arange(12) % 2)
    at_sample = method.transferred_to_sample(np.arange(12), np.arange(12) % 2, np.zeros(12))
    said += [array[row, :n] for row, n in enumerate(at_sample.length[:12]) for array in at_sample[1:]]
    return [np.asarray(each, dtype=np.float64).copy() for each in said]


def assert_same(one, other):
    for ours, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def without_seconds(method):
    return {name: value for name, value in method.statistics().items() if "seconds" not in name}


@pytest.mark.parametrize("n", [0, 15, 35])
@pytest.mark.parametrize("name", VARIANTS)
def test_what_is_restored_goes_on_as_if_nothing_had_happened(name, n):
    """Made of its arguments, before it has seen anything, before its mapping is found and afterwards."""
    method = bound(VARIANTS[name](), TASK)
    live(method, 0, n)
    again, state = bound(type(method)(**method.arguments()), TASK, seed=9), method.get_state()
    shapes = [{key: array.shape[1:] for key, array in each.get_state().items()} for each in (method, again)]
    assert shapes[0] == shapes[1] and all(array.dtype == np.float64 for array in state.values())
    again.set_state(state)
    again.rng.bit_generator.state = method.rng.bit_generator.state
    changed_pairs(method)
    changed_pairs(again)
    for last in (n, 50):
        assert_same(live(method, n, last), live(again, n, last))
        assert_same(method.get_state().values(), again.get_state().values())
        np.testing.assert_equal(without_seconds(method), without_seconds(again))


@pytest.mark.parametrize("name", VARIANTS)
def test_a_deep_copy_goes_on_as_the_method_does(name):
    method = bound(VARIANTS[name](), TASK)
    live(method, 0, 25)
    copied = copy.deepcopy(method)
    assert_same(live(method, 25, 50), live(copied, 25, 50))
    assert_same(method.get_state().values(), copied.get_state().values())
    np.testing.assert_equal(without_seconds(method), without_seconds(copied))


@pytest.mark.parametrize("name", VARIANTS)
def test_the_seed_decides(name):
    said = [live(bound(VARIANTS[name](), TASK, seed), 0, 40) for seed in (0, 0, 1)]
    assert_same(said[0], said[1])
    if name in RANDOM:
        assert len(said[0]) != len(said[2]) or not all(map(np.array_equal, said[0], said[2]))


LEARNING = {
    "Mine": lambda source: Mine(reward=-2.0),
    "COMBREL": lambda source: COMBREL([source, source], use="instances"),
    "TIMBREL": lambda source: TIMBREL(source, "random"),
    "MASTER": lambda source: MASTER(source, n_random_steps=15),
    "MappingExperts": lambda source: MappingExperts(source, max_experts=3, patience=None),
    "SampleTransfer": lambda source: SampleTransfer(source, min_transitions=15),
    "SoftHomomorphism": lambda source: SoftHomomorphism(source, n_starts=2, mirrored=False),
    **{kind.__name__: lambda source, kind=kind: kind(source, **SAMPLES, **FEW[kind]) for kind in FEW},
}


@pytest.mark.parametrize("name", LEARNING)
def test_it_learns_and_is_saved_loaded_and_reported(name, tmp_path):
    path = walk_source().save(tmp_path / "source.npz")
    model = small(transfer=LEARNING[name](str(path)))
    model.learn(10_000, StopTrainingOnMaxEpisodes(3))
    model.save(tmp_path / "model")
    # The file of a model depends on no other.
    path.unlink()
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert type(loaded.transfer).__name__ == name and same_parameters(model, loaded)
    assert loaded.transfer.arguments().keys() == model.transfer.arguments().keys()
    text, same = (
        [line for line in str(each.transfer.report()).splitlines() if "seconds" not in line] for each in (model, loaded)
    )
    assert text == same and text[0].startswith(f"{name}(")
    if name in ("COMBREL", "TIMBREL", "Mine"):
        said = "says nothing of its mappings" if name == "Mine" else f"of {model.num_timesteps} steps"
        assert said in str(text) and "nan" not in str(text)
    report = loaded.learn(40, reset_num_timesteps=False).transfer.report()
    assert loaded.agent.model.n_instances == model.num_timesteps + 40
    assert report.statistics.keys() == model.transfer.statistics().keys()
    assert report.statistics.get("transfer/expert_episodes", 1) > 0


WHOLE, POSITIVE = "must be a whole number of at least 1, got", "must be a number above 0"
FACTORED = FactoredMapping((InterTaskMapping([0, 1], [0, 1]),))
REFUSED = [
    *((kind, {"breadth": 0.0}, f"breadth {POSITIVE}, got 0.0") for kind in (MASTER, SampleTransfer, *FEW)),
    *((kind, {"breadth_decay": 1.1}, "breadth_decay .* and at most 1, got 1.1") for kind in (MASTER, *FEW)),
    *((kind, {"transfer_terminals": 1}, "must be True or False, got 1") for kind in (MASTER, *FEW)),
    *((kind, {"source_breadth": np.nan}, f"source_breadth {POSITIVE}, got nan") for kind in (MASTER, SoftHomomorphism)),
    *((kind, {"mappings": "factored"}, "no factored ones, got 'f") for kind in (MASTER, MappingExperts, SampleTransfer)),
    *((kind, {"mappings": FACTORED}, "no factored ones") for kind in (MASTER, MappingExperts, SampleTransfer)),
    *((kind, {"n_random_steps": 9}, "n_random_steps must be a whole number of at least 10, got 9") for kind in FEW),
    *((kind, {"n_source_samples": 1e3}, "n_source_samples must be a whole number") for kind in FEW),
    *((MASTER, {"n_random_steps": value}, f"n_random_steps {WHOLE} {value!r}") for value in (0, 2.5, None, True)),
    (MASTER, {"use": "model"}, 'use must be "instances" or "prior", got \'model\''),
    (MappingExperts, {"max_experts": 2.0}, f"max_experts {WHOLE} 2.0"),
    (MappingExperts, {"exploration": -0.1}, "exploration must be at least 0, got -0.1"),
    (MappingExperts, {"exploration": np.nan}, "exploration must be a finite number, got nan"),
    (MappingExperts, {"patience": "long"}, f"patience {POSITIVE}, got 'long'"),
    (MappingExperts, {"gamma": 1.0}, "gamma must be below 1, got 1.0"),
    (MappingExperts, {"gamma": 0.0}, "gamma must be a number above 0 and at most 1, got 0.0"),
    (MappingExperts, {"source_breadth": None}, f"source_breadth {POSITIVE}, got None"),
    (SampleTransfer, {"n_instances": 0}, f"n_instances {WHOLE} 0"),
    (SampleTransfer, {"min_transitions": 60, "max_transitions": 59}, "max_.* at least min_transitions=60, got 59"),
    (SampleTransfer, {"relevance": "far"}, "relevance must be True, False or \"near\", got 'far'"),
    (SampleTransfer, {"relevance_fraction": 0.0}, "relevance_fraction must be a number above 0 and at most 1, got 0.0"),
    (SampleTransfer, {"bandwidths": (1.0, 2.0)}, "bandwidths must be three numbers"),
    (SoftHomomorphism, {"n_copies": 0}, "n_copies must be a whole number of at least 1 or None, got 0"),
    (SoftHomomorphism, {"n_starts": 1.5}, f"n_starts {WHOLE} 1.5"),
    (SoftHomomorphism, {"max_transitions": 9}, "max_transitions must be a whole number of at least 10, got 9"),
    (SoftHomomorphism, {"mirrored": 1}, "mirrored must be True or False, got 1"),
    (SparseCodingMapping, {"n_atoms": 0}, "n_atoms must be .*, got 0"),
    (SparseCodingMapping, {"sparsity": 0.0}, f"sparsity {POSITIVE}, got 0.0"),
    *((ThreeWayRBM, {name: -1}, f"{name} {WHOLE} -1") for name in ("n_hidden", "n_factors", "n_updates")),
]


@pytest.mark.parametrize(("kind", "arguments", "message"), REFUSED)
def test_an_argument_out_of_its_range_is_refused_by_name_and_value(kind, arguments, message):
    with pytest.raises(ValueError, match=message):
        kind(walk_source(), **arguments)


@pytest.mark.parametrize("kind", [MASTER, MappingExperts, SampleTransfer])
def test_mappings_that_do_not_fit_the_target_are_refused(kind):
    with pytest.raises(ValueError, match="action must hold indices from 0 to 1"):
        bound(kind(SOURCE, InterTaskMapping([0, None, 1], [0, 2])), TASK)


@pytest.mark.parametrize("kind", [SoftHomomorphism, *FEW])
def test_more_than_one_source_is_refused_by_methods_that_take_one(kind):
    with pytest.raises(ValueError, match=f"source must be one source with {kind.__name__}, got 2"):
        bound(kind([SOURCE, SOURCE]), TASK)


@pytest.mark.parametrize("make", [lambda *given: MASTER(*given, n_random_steps=5), SampleTransfer])
def test_sets_of_too_many_restricted_action_mappings_are_refused(make):
    """12 target actions on 4 source actions, equally often, are 369,600; all there are, many more, are no problem."""
    source, task = naive.random_source(np.random.default_rng(0), 60, 2, 4), naive.target_task(np.zeros((1, 2)), 12)
    with pytest.raises(ValueError, match=r"mappings must have at most 100,000 action mappings, .* got 369,600"):
        bound(make(source, MappingSet.balanced(2, 2, 4, 12)), task)
    bound(make(source), task)


@pytest.mark.parametrize("method", [SoftHomomorphism(SOURCE), MASTER(SOURCE, use="prior"), COMBREL(SOURCE, "factored")])
def test_a_prior_needs_the_local_linear_model(method):
    method.check_degree(1)
    with pytest.raises(ValueError, match=r'\(use="prior"\) needs the local linear model, .* got degree=0'):
        method.check_degree(0)
