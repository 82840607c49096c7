"""Sources, mappings and arguments of transfer that cannot work: an error that says what to change, before the first step."""

import dataclasses
import warnings

import numpy as np
import pytest
from gymnasium import Env, spaces
from helpers import factored as f
from helpers import naive_transfer as naive
from helpers.oscillators import episodes
from helpers.own_method import Mine
from helpers.walk import small, walk_source

from sb3_combrel import COMBREL, MASTER, TIMBREL, FittedRMax
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet


class Untouched(Env):
    """A task with three variables and two actions that nobody may step in."""

    observation_space, action_space = spaces.Box(-1.0, 1.0, (3,), dtype=np.float64), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        raise AssertionError("the error should have come before")

    step = reset


TURNS = (True, False)
OF_A_PRIOR, TWO = f.oscillator_source(60), f.copies_mapping(2)
METHODS = [COMBREL, TIMBREL]


@pytest.fixture
def source():
    return naive.random_source(np.random.default_rng(0), 30, 2, 2)


def refused(make, *says, error=ValueError, task=None):
    """The method is refused when it is made or bound to a task of three variables and two actions, or to another one."""
    with pytest.raises(error) as caught:
        make().bind(naive.target_task(np.zeros((1, 3)), 2) if task is None else task, np.random.default_rng(0))
    for words in says:
        assert words in str(caught.value)


def test_a_model_is_refused_when_it_is_made(source):
    with pytest.raises(ValueError, match="state must have 3 entries"):
        FittedRMax(Untouched(), transfer=COMBREL(source, InterTaskMapping([0, 1], [0, 1])), resolution=3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("mapping", "says"),
    [
        (InterTaskMapping([0, None, 1, None], [0, 1]), ["state must have 3 entries", "got 4"]),
        (InterTaskMapping([0, 1], [0, 1]), ["state must have 3 entries", "got 2"]),
        (InterTaskMapping([0, None, 1], [0, 1, 1]), ["action must have 2 entries", "got 3"]),
        (InterTaskMapping([0, None, 2], [0, 1]), ["state must hold indices from 0 to 1", "got 2"]),
        (InterTaskMapping([0, None, 1], [0, 2]), ["action must hold indices from 0 to 1", "got 2"]),
    ],
    ids=["long state", "short state", "long action", "no such variable", "no such action"],
)
def test_a_mapping_that_does_not_fit_the_spaces_is_refused(method, mapping, says, source):
    refused(lambda: method(source, mapping), *says)
    refused(lambda: method(source, [mapping, mapping]), *says)
    refused(lambda: method(source, {"state": list(mapping.state), "action": list(mapping.action)}), *says)


def test_sets_that_do_not_exist_or_fit_are_refused(source):
    refused(lambda: COMBREL(source, MappingSet.injective(2, 4, 2, 2)), "must", "3", "4")
    refused(lambda: COMBREL(source, "paper_mountain_car"), "must", "3", "4")
    refused(lambda: TIMBREL(source, "pool", mappings=MappingSet.injective(2, 3, 3, 2)), "indices from 0 to 1", "got 2")
    refused(lambda: COMBREL(source, "bijective"), "mappings must be one of", "injective", "paper_icub", "'bijective'")
    refused(lambda: COMBREL(source, []), "mappings must hold at least one")
    refused(lambda: COMBREL(source, [7]), "mappings must be", "7")
    refused(lambda: COMBREL(source, {"state": [0, None, 1]}), "dict of state, action", "[0, None, 1]")
    fits = InterTaskMapping([0, None, 1], [0, 1])
    refused(lambda: TIMBREL(source, [fits] * 3), "must be one mapping or one for each of the 2 target actions", "got 3")
    refused(lambda: TIMBREL(source, "best"), "mapping must be", '"random" or "pool"', "'best'")


@pytest.mark.parametrize("method", METHODS)
def test_a_source_that_is_missing_damaged_or_of_another_task_is_refused(method, source, tmp_path):
    refused(lambda: method(tmp_path / "nowhere.npz"), "nowhere.npz", "SourceInstances.record", error=FileNotFoundError)
    path, mapping = source.save(tmp_path / "source.npz"), InterTaskMapping([0, None, 2], [0, 1])
    refused(lambda: method(str(path), mapping), "state must hold indices from 0 to 1", "the source task has 2 variables")
    path.write_bytes(b"not a source")
    refused(lambda: method(path), "source.npz", "not source instances")
    for nothing in ([], None, 5, {}):
        refused(lambda: method(nothing), "source must be SourceInstances, a file", repr(nothing))  # noqa: B023


BAD_ARGUMENTS = {
    "breadth": (0.0, np.nan, "wide", None),
    "breadth_decay": (0.0, 1.1),
    "relevance_fraction": (1.5,),
    "bandwidths": ((0.1, 0.1), (0.1, 0.0, 1.0), (0.1, np.nan, 1.0), "auto"),
    "relevance": (None, "no", 1),
    "transfer_terminals": (None, 0.0),
    "source_breadth": (0.0, np.nan),
    "use": ("model",),
}
BAD_ARGUMENTS_OF_COMBREL = {
    "min_compliance": (-0.1, None),
    "min_evidence": (np.nan, -0.1),
    "n_neighbors": (0, 2.5, True),
    "measured": ("never",),
    "choice": ("worst",),
    "neighbors": ("both",),
    "max_transitions": (0, 1e3),
}
ALL_BAD_ARGUMENTS = [(TIMBREL, name, value) for name, values in BAD_ARGUMENTS.items() for value in values]
ALL_BAD_ARGUMENTS += [
    (COMBREL, name, value) for name, values in (BAD_ARGUMENTS | BAD_ARGUMENTS_OF_COMBREL).items() for value in values
]


@pytest.mark.parametrize(("method", "name", "value"), ALL_BAD_ARGUMENTS)
def test_an_argument_out_of_its_range_is_refused_at_once_by_name_and_value(method, name, value, source):
    with pytest.raises(ValueError, match=f"{name} must be") as error:
        method(source, **{name: value})
    culprits = value if isinstance(value, tuple) else [value]
    assert any(repr(culprit) in str(error.value) for culprit in culprits)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda s: COMBREL(s, "factored", use="instances"), 'factored mappings need use="prior", got use="instances"'),
        (lambda s: TIMBREL(s, TWO), 'factored mappings need use="prior"'),
        (lambda s: TIMBREL(s, {"copies": []}), 'factored mappings need use="prior"'),
        (lambda s: TIMBREL(s, "random", mappings="signed_factored"), 'factored mappings need use="prior"'),
        (lambda s: TIMBREL(s, "pool", use="prior"), 'mapping must be a mapping or "random"'),
        (lambda s: TIMBREL(s, TWO, use="prior", relevance=True), "relevance=True must be left out"),
        (
            lambda s: TIMBREL(s, TWO, use="prior", breadth=0.2, breadth_decay=0.5),
            "breadth=0.2, breadth_decay=0.5 must be left",
        ),
        (lambda s: MASTER(s, use="prior", breadth=0.2), "breadth=0.2 must be left out"),
        (lambda s: TIMBREL(s, f.copies_mapping(3), use="prior"), "state must have 4 entries"),
        (lambda s: TIMBREL(s, {"copies": [{"state": [0, 1, None, 2], "action": [0] * 5}]}, use="prior"), "from 0 to 1"),
        (lambda s: TIMBREL(s, {"copies": []}, use="prior"), "at least one"),
        (lambda s: TIMBREL(s, [InterTaskMapping([0, 1, None, None], [0] * 5)] * 2, use="prior"), "one for each of the 5"),
        (lambda s: COMBREL(s, "factorised", use="prior"), "mappings must be one of"),
    ],
)
def test_priors_that_cannot_be_are_refused(make, says):
    refused(lambda: make(OF_A_PRIOR), says, task=f.target_task(4, 5))


def test_sets_that_are_too_large_are_refused_with_what_to_do():
    says = "at most 12 state variables, got 13; give a FactoredMapping"
    refused(lambda: COMBREL(OF_A_PRIOR, "factored", use="prior"), says, task=f.target_task(13, 5))
    wide = naive.random_source(np.random.default_rng(0), 9, 6, 1)
    refused(lambda: COMBREL(wide, "factored", use="prior"), "more than the 2,000", task=f.target_task(6, 5))
    source, task = naive.random_source(np.random.default_rng(0), 20, 2, 4), naive.target_task(np.zeros((1, 6)), 8)
    says = 'at most 20000 whole mappings with neighbors="state_action"', 'neighbors="action"'
    refused(lambda: COMBREL(source, "all", neighbors="state_action"), *says, task=task)
    f.bound(COMBREL(source, "all"), 6, 8)


def test_what_is_asked_of_a_prior_needs_one(source):
    class Promising(Mine):
        use = "prior"

    with pytest.raises(NotImplementedError, match="Promising"):
        Promising().prior(np.zeros((1, 2)), np.zeros(1, dtype=np.int64))
    assert Promising().prior_version() == 0
    with pytest.raises(ValueError, match='use must be "prior"'):
        f.bound(COMBREL(source)).describe_prior()


# Sources that are poor but not wrong: learning goes on, whatever they lack.
def without_action(source):
    return dataclasses.replace(source, **rows_of(source, source.actions != 2))


def one_transition(source):
    return dataclasses.replace(source, **rows_of(source, np.arange(len(source)) == 7))


def constant_effects(source):
    after = np.clip(source.states + np.array([0.02, 0.0]), source.scaling.low, source.scaling.high)
    return dataclasses.replace(source, next_states=after)


def at_rest(source):
    return dataclasses.replace(source, next_states=source.states)


def at_one_place(source):
    states = np.tile(source.states[0], (len(source), 1))
    return dataclasses.replace(source, states=states, next_states=states + (source.next_states - source.states))


def rows_of(source, chosen):
    return {name: getattr(source, name)[chosen] for name in ("states", "actions", "rewards", "next_states", "terminated")}


@pytest.mark.parametrize("use", ["prior", "instances"])
@pytest.mark.parametrize("poor", [without_action, one_transition, constant_effects, at_rest, at_one_place])
@pytest.mark.filterwarnings("ignore:what was transferred")
def test_learning_goes_on_with_a_poor_source_and_predicts_finite_numbers(poor, use):
    source = poor(f.oscillator_source(60))
    model, _ = episodes(COMBREL(source, use=use, mappings=None), 1, 2, 0)
    values = model.agent.planner.values
    assert np.isfinite(values).all() and np.isfinite(model.agent.q_values(np.array([0.5, 0.5]))).all()
    assert str(model.transfer.report())
    if use == "prior":
        found = model.agent.transfer.prior(np.random.default_rng(0).random((20, 2)), np.arange(20) % 3)
        assert all(np.isfinite(array).all() for array in found)


def test_a_source_of_the_target_itself_makes_the_prior_exact_and_bounds_the_values():
    model, _ = episodes(COMBREL(f.oscillator_source(600)), 1, 2, 0)
    transfer = model.agent.transfer
    states, actions = f.inside(50, 2, 3)
    np.testing.assert_allclose(transfer.prior(states, actions).effect, f.oscillate(states, actions), atol=2e-3)
    assert transfer.value_bound() is not None and transfer.source_prior.evidence.strength.mean() > 0.5


@pytest.mark.parametrize("use", ["prior", "instances"])
def test_a_mapping_that_is_given_is_of_one_source(use):
    mapping = InterTaskMapping(state=(0, 1), action=(0, 1))
    with pytest.raises(ValueError, match="source must be one source for a mapping that is given, got 2"):
        small(transfer=TIMBREL([walk_source(), walk_source(50)], mapping, use=use), degree=1)


def test_what_has_no_meaning_for_a_prior_is_refused():
    with pytest.raises(ValueError, match=r"n_neighbors=20, choice='drawn' must be left out with use=\"prior\""):
        COMBREL(walk_source(), use="prior", n_neighbors=20, choice="drawn")
    with pytest.raises(ValueError, match=r"breadth=0\.1 must be left out"):
        COMBREL(walk_source(), "factored", breadth=0.1)


# Copies by hand: of six variables in six there are 13,326, of five in five 1,545, mirrored ones not counted.
@pytest.mark.parametrize(("n_variables", "name", "n_copies"), [(5, "factored", "19,090"), (6, "injective", "291,792")])
def test_by_default_combrel_looks_through_the_largest_set_that_is_practical(n_variables, name, n_copies):
    rng = np.random.default_rng(0)
    source = naive.random_source(rng, 30, n_variables, 2)
    method, task = COMBREL(source), dataclasses.replace(f.target_task(n_variables, 2), takes_prior=True)
    with pytest.warns(
        UserWarning, match=f'mappings="signed_factored", the default, has {n_copies} copies .*"{name}" is taken'
    ):
        method.bind(task, rng)
    assert (method.mappings, method.use) == (name, "prior")
    assert np.isfinite(method.prior(rng.random((3, n_variables)), np.zeros(3, dtype=np.int64)).effect).all()
    refused(lambda: COMBREL(source, "signed_factored"), n_copies, 'give "injective"', task=task)


@pytest.mark.filterwarnings("error")
def test_by_default_combrel_looks_for_mirrored_variables_without_a_word_where_that_is_practical():
    method = COMBREL(naive.random_source(np.random.default_rng(0), 30, 2, 2))
    method.bind(dataclasses.replace(f.target_task(4, 2), takes_prior=True), np.random.default_rng(0))
    assert method.mappings == "signed_factored"


def test_timbrel_without_a_mapping_is_warned_of():
    with pytest.warns(UserWarning, match="mapping is left out, and random ones are drawn, which is the control") as caught:
        assert TIMBREL(walk_source()).mapping == "random"
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        TIMBREL(walk_source(), "random")


def test_angles_that_another_source_has_not_are_told():
    walk = walk_source()
    angles, others = (dataclasses.replace(walk, periodic=flags, state_names=("angle", "mass")) for flags in (TURNS, ()))
    with pytest.warns(UserWarning, match="state variables of a source, angle, are periodic, and those in the same place"):
        small(transfer=COMBREL([angles, others]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small(transfer=COMBREL([angles, angles]))
