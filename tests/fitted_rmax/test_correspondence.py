"""A learner that scales its variables by what is observed still sees what corresponds to them by their bounds."""

import numpy as np
import pytest
from helpers.walk import STRIDE, Walk, same_parameters, walk_source
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.fitted_rmax.correspondence import Correspondence, OfLearner
from sb3_combrel.fitted_rmax.scales import FoundScales

numbers = st.floats(-100.0, 100.0)
ranges = st.floats(0.1, 100.0)


def vectors(elements):
    return arrays(np.float64, 3, elements=elements)


@given(vectors(numbers), vectors(ranges), vectors(numbers), vectors(ranges), vectors(numbers), vectors(numbers))
def test_states_and_effects_are_those_of_the_bounds(low, used, bound, width, state, effect):
    scaling, bounds = StateScaling(low, low + used), StateScaling(bound, bound + width)
    correspondence = Correspondence(scaling, bounds)
    close = dict(rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(correspondence.states(scaling.to_unit(state)), bounds.to_unit(state), **close)
    seen = correspondence.effects(effect / used)
    np.testing.assert_allclose(seen, effect / width, **close)
    np.testing.assert_allclose(correspondence.effects_of_learner(seen), effect / used, **close)


def test_nothing_is_computed_where_the_coordinates_are_the_same():
    same, state = StateScaling([0.0], [3.0]), np.array([0.1])
    correspondence = Correspondence(same, StateScaling([0.0], [3.0]))
    for computed in (correspondence.states, correspondence.effects, correspondence.effects_of_learner):
        assert computed(state) is state


class WideWalk(Walk):
    """The walk, with bounds that are far too wide."""

    def __init__(self):
        super().__init__()
        self.observation_space = type(self.observation_space)(np.float32([-20.0, 0.0]), np.float32([20.0, 2.0]))


def wide_source():
    """Of the walk; its bounds are those of ``WideWalk``."""
    narrow = walk_source()
    return type(narrow)(
        *(narrow.states, narrow.actions, narrow.rewards, narrow.next_states, narrow.terminated),
        *([-20.0, 0.0], [20.0, 2.0], 2),
    )


def learnt(transfer, **kwargs):
    return FittedRMax(WideWalk(), transfer=transfer, seed=0, resolution=3, **kwargs).learn(150)


SAME = InterTaskMapping([0, 1], [0, 1])
METHODS = {
    "prior": lambda: TIMBREL(wide_source(), SAME, use="prior"),
    "chosen": lambda: COMBREL(wide_source()),
}


@pytest.mark.parametrize("make", METHODS.values(), ids=METHODS)
def test_a_source_fits_a_target_whose_scales_are_finer_than_its_bounds(make, tmp_path):
    model = learnt(make())
    scaling, seen = model.policy.scales.scaling, model.transfer.task.scaling
    assert scaling.high[0] - scaling.low[0] < 4.0
    np.testing.assert_array_equal((seen.low[0], seen.high[0]), (-20.0, 20.0))
    assert model.transfer.region_errors.task.scaling == seen
    assert model.transfer.statistics()["transfer/prediction_error"] < 0.1
    model.save(tmp_path / "wide")
    assert same_parameters(model, FittedRMax.load(tmp_path / "wide"))


def test_what_a_source_predicts_is_the_same_in_raw_units():
    model = learnt(METHODS["prior"]())
    units = np.column_stack([np.linspace(0.3, 0.6, 5), np.ones(5) / 2])
    for action, effect in enumerate((-STRIDE, STRIDE)):
        given = model.agent.model.transfer.prior(units, np.full(5, action))
        scaling = model.policy.scales.scaling
        np.testing.assert_allclose(given.effect * (scaling.high - scaling.low), [[effect, 0.0]] * 5, atol=0.02)


NARROW = StateScaling([-2.0, 0.0], [2.0, 2.0])


@pytest.fixture
def instances():
    """What transfers instances to a learner that has them, and the same for one with narrower scales."""
    model = learnt(TIMBREL(wide_source(), SAME, use="instances", breadth=0.01))
    correspondence = Correspondence(NARROW, model.agent.task.bounds)
    return model.transfer, OfLearner(model.transfer, correspondence)


def test_once_instances_are_transferred_variables_take_all_of_their_bounds(tmp_path):
    class Later(TIMBREL):
        """Transfers from the 32nd transition on."""

        n = 0

        def observe(self, *transition):
            super().observe(*transition)
            self.n += 1

        def transferred(self, states, actions, own_weight):
            found = super().transferred(states, actions, own_weight)
            return found if self.n >= 32 else TransferredInstances.empty(len(actions), states.shape[1])

        def transferred_to_sample(self, points, actions, own_weight):
            return self.transferred(self.task.sample_states[points], actions, own_weight)

    model = FittedRMax(WideWalk(), transfer=Later(wide_source(), SAME, breadth=0.01), seed=0, resolution=3).learn(31)
    assert model.policy.scales.scaling.high[0] - model.policy.scales.scaling.low[0] < 4.0 and not model.agent.transfers
    model.learn(60, reset_num_timesteps=False)
    for each in (model, model.learn(40, reset_num_timesteps=False)):
        assert (each.policy.scales.scaling.low[0], each.policy.scales.scaling.high[0]) == (-20.0, 20.0)
    kept = FoundScales(model.observation_space, None, np.zeros(2, dtype=bool))
    kept.set_state(model.policy.scales.get_state())
    assert kept.renewed(episode_ended=True) is None


def test_transferred_instances_are_the_same_in_raw_units(instances):
    states = np.column_stack([np.linspace(0.3, 0.7, 40), np.full(40, 0.5)])
    points = np.arange(len(instances[0].task.sample_states))
    for action, effect in enumerate((-STRIDE, STRIDE)):
        for ask, at in ((instances[1].transferred, states), (instances[1].transferred_to_sample, points)):
            found = ask(at, np.full(len(at), action), np.zeros(len(at)))
            used = np.arange(found.weight.shape[1]) < found.length[: len(at), None]
            moved = found.effect[: len(at)][used] * 4.0
            assert len(moved) > 1 and (np.abs(moved - effect) < 0.02).any(axis=1).mean() > 0.5


def test_what_a_method_hears_of_its_use_is_what_it_gave(instances, monkeypatch):
    method, of_learner = instances
    used = []
    monkeypatch.setattr(type(method), "note_use", lambda self, found: used.append(found))
    asked = np.array([[0.5, 0.5]] * 2), np.arange(2), np.zeros(2)
    of_learner.note_use(of_learner.transferred(*asked))
    given = method.transferred(Correspondence(NARROW, method.task.scaling).states(asked[0]), *asked[1:])
    np.testing.assert_allclose(used[0].effect, given.effect, rtol=1e-9)
    np.testing.assert_array_equal(used[0].weight, given.weight)


@pytest.mark.parametrize("same", [False, True], ids=["other units", "the same units"])
@pytest.mark.parametrize("ask", ["transferred", "transferred_to_sample"])
def test_what_breaks_the_contract_is_refused_and_the_method_named(instances, monkeypatch, ask, same):
    method, bounds = instances[0], instances[0].task.scaling
    of_learner = OfLearner(method, Correspondence(bounds if same else NARROW, bounds))
    monkeypatch.setattr(TIMBREL, ask, lambda self, *asked: TransferredInstances.empty(1, 2)._replace(length=np.array([5])))
    asked = np.zeros((1, 2) if ask == "transferred" else 1, dtype=np.int64)
    with pytest.raises(ValueError, match="TIMBREL returned length=5 for row 0"):
        getattr(of_learner, ask)(asked, np.zeros(1, dtype=np.int64), np.zeros(1))


@pytest.mark.parametrize(
    "make", (METHODS["chosen"], lambda: COMBREL(wide_source(), use="instances", breadth=0.01)), ids=("prior", "instances")
)
def test_what_was_learned_of_a_source_stays_when_the_learner_is_scaled_anew(make):
    model = learnt(make())
    agent, transfer, bounds = model.agent, model.transfer, model.agent.task.bounds
    before, n_instances = transfer.get_state(), agent.model.n_instances
    agent.rescale(StateScaling([-2.0, 0.0], [2.0, 2.0]), bounds)
    assert agent.model.n_instances == n_instances
    for name, array in transfer.get_state().items():
        # Choices are those of grid points, which are elsewhere now.
        if name not in ("choice", "vote_due"):
            np.testing.assert_array_equal(array, before[name], err_msg=name)
    if transfer.use != "prior":
        return
    states, actions = np.array([[0.5, 0.5]] * 2), np.arange(2)
    given = agent.model.transfer.prior(states, actions)
    np.testing.assert_allclose(given.effect[:, 0] * 4.0, [-STRIDE, STRIDE], atol=0.02)
