"""What is known stays known at exact states too, where nothing is stored."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.base import ModelSettings
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.mdp import FiniteMDP

BREADTH, MIN_FRACTION = 0.2, 0.1
STATE = np.array([0.5, 0.5])


def new_model():
    mdp = FiniteMDP(StateGrid(2, 2), 1, 1.0)
    return KernelAverage(mdp, ModelSettings(BREADTH, 0.01, MIN_FRACTION, 1.0))


def add(model, weight, angle=0.0):
    """An instance that weighs so much at ``STATE``."""
    away = BREADTH * np.sqrt(-np.log(weight))
    start = STATE + away * np.array([np.cos(angle), np.sin(angle)])
    model.add(start, 0, -weight, start + 0.05, False)


def test_kernel_average_knows_an_exact_state_when_a_nearer_instance_shortens_its_list():
    model = new_model()
    for weight in (0.8535, 0.0965, 0.096):
        add(model, weight)
    assert model.predict_at(STATE)[0].modelled[0]
    # 0.8535 + 0.12 is below the threshold, and 0.0965 below a tenth of it: the list is cut there.
    add(model, 0.12)
    prediction, _ = model.predict_at(STATE)
    assert prediction.modelled[0] and prediction.weight[0] == 1.0
    kept = np.array([0.8535, 0.12])
    assert prediction.length[0] == 2
    np.testing.assert_allclose(prediction.probability[0, :2], kept / kept.sum())
    np.testing.assert_allclose(prediction.reward[0], -(kept**2).sum() / kept.sum())


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.lists(st.one_of(st.floats(0.011, 0.999), st.floats(0.09, 0.12), st.floats(0.8, 0.9)), min_size=2, max_size=14))
def test_kernel_average_never_forgets_that_an_exact_state_is_known(weights):
    model, known = new_model(), False
    for number, weight in enumerate(weights):
        add(model, weight, angle=float(number))
        known_now = bool(model.predict_at(STATE)[0].modelled[0])
        assert known_now or not known
        known = known_now


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.lists(st.floats(0.011, 0.999), min_size=1, max_size=8))
def test_kernel_average_knows_an_exact_state_only_if_some_of_its_instances_alone_reach_the_threshold(weights):
    model = new_model()
    for number, weight in enumerate(weights):
        add(model, weight, angle=float(number))
    heavy = [w for w in weights if w >= MIN_FRACTION / (1.0 + MIN_FRACTION)]
    total = sum(heavy)
    if abs(total - 1.0) > 1e-9:
        assert model.predict_at(STATE)[0].modelled[0] == (total >= 1.0)
