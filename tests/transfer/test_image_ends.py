"""Which of a copy and its mirror images bounds values: on a line whose effects are their own mirror image."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.prior import prior_choice
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.image_ends import best_ending, best_source
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

STEP, GOAL = 0.05, 0.9
RATES = st.floats(0.001, 0.999)


@given(st.lists(st.tuples(RATES, st.booleans()), min_size=1, max_size=20))
def test_the_evidence_of_ends_is_the_logarithm_of_their_probability(transitions):
    foretold, ended = np.array([each[0] for each in transitions]), np.array([each[1] for each in transitions])
    probability = 1.0
    for p, end in transitions:
        probability *= p if end else 1.0 - p
    assert equations.ends_evidence(ended, foretold) == pytest.approx(np.log(probability), rel=1e-9, abs=1e-12)


@given(st.floats(0.0, 1.0), st.floats(0.0, 24.0), RATES)
def test_a_source_without_data_foretells_ends_at_its_rate_and_with_much_at_theirs(share, weight, rate):
    [without, some, much] = equations.foretold_ends(np.full(3, share), np.array([0.0, weight, 1e9]), rate)
    assert without == rate and much == pytest.approx(share, abs=1e-6)
    assert min(rate, share) - 1e-12 <= some <= max(rate, share) + 1e-12


def line_source(low=0.0, goal=GOAL, seed=0):
    """400 transitions on a line from ``low`` to 1; an episode ends above ``goal``."""
    rng = np.random.default_rng(seed)
    states, actions = low + (1.0 - low) * rng.random((400, 1)), rng.integers(2, size=400)
    after = np.clip(states + np.where(actions == 1, STEP, -STEP)[:, None], 0.0, 1.0)
    return SourceInstances(states, actions, -np.ones(400), after, after[:, 0] > goal, [0.0], [1.0], 2, ("x",), ("down", "up"))


def seen(n_variables, ends, low=0.1, high=0.9, n=200, seed=1):
    """Transitions of a target whose variables all move up or down; ``ends``: whether an episode ends at a next state."""
    rng = np.random.default_rng(seed)
    transitions, states = RecordedTransitions(n_variables), low + (high - low) * rng.random((n, n_variables))
    for state in states:
        action = int(rng.integers(2**n_variables))
        effect = np.where(action >> np.arange(n_variables) & 1, STEP, -STEP)
        transitions.add(state, action, -1.0, effect, bool(ends(state + effect)))
    return transitions


def chosen_for(transitions, source):
    """All copies of the line, plain and mirrored, what is chosen from them by effects, and what bounds values."""
    d = transitions.states.shape[1]
    state = np.where(np.repeat(np.eye(d), 2, axis=0) > 0, 0, -1)
    sign = np.where((np.arange(2 * d) % 2 == 1)[:, None] & (state >= 0), -1.0, 1.0)
    copies = Copies([source], np.zeros(2 * d, dtype=np.int64), state, sign, 0.2)
    sums = CopySums.zero(2 * d, 2, 2**d, d)
    for i in range(transitions.n):
        copies.measure(transitions.states[i], int(transitions.actions[i]), transitions.effects[i], sums)
    choice = prior_choice.choose_factored(copies, sums)
    return choice.copies[0].tolist(), best_ending(copies, sums, choice, transitions)


@pytest.mark.parametrize(
    ("ends", "bounding"),
    [
        (lambda x: x[0] > GOAL, 0),
        (lambda x: x[0] < 1.0 - GOAL, 1),
    ],
    ids=["plain", "mirrored"],
)
def test_the_image_that_foretells_the_ends_bounds_values(ends, bounding):
    choice, found = chosen_for(seen(1, ends), line_source())
    assert choice == [0] and found.copies[0].tolist() == [bounding]


def test_an_end_that_is_foretold_and_does_not_come_speaks_for_the_image():
    """States are seen at the side alone where the plain copy ends."""
    choice, found = chosen_for(seen(1, lambda x: False, low=0.4), line_source())
    assert choice == [0] and found.copies[0].tolist() == [1]


def test_without_any_end_foretold_or_seen_the_copy_that_is_chosen_bounds_values():
    choice, found = chosen_for(seen(1, lambda x: False, low=0.3, high=0.7), line_source())
    assert choice == [0] and found.copies[0].tolist() == [0]


@pytest.mark.parametrize("mirrored", [(False, False), (False, True), (True, False), (True, True)])
def test_a_target_of_two_copies_ends_where_both_have_ended(mirrored):
    def ends(x):
        return (np.where(mirrored, 1.0 - x, x) > GOAL).all()

    transitions = seen(2, ends, low=0.03, high=0.97, n=1000)
    assert transitions.ended[: transitions.n].sum() >= 3
    choice, found = chosen_for(transitions, line_source())
    assert choice == [0, 2] and found.copies[0].tolist() == [0 + mirrored[0], 2 + mirrored[1]]
    assert (found.copies == found.copies[0]).all()


def test_a_copy_that_effects_tell_from_its_image_stays():
    """What always moves up has no mirror image, wherever it ends."""
    rng = np.random.default_rng(0)
    states = rng.random((400, 1))
    after = states + 0.02 + 0.1 * states**2
    source = SourceInstances(
        states, np.zeros(400, dtype=np.int64), -np.ones(400), after, after[:, 0] > GOAL, [0.0], [1.2], 1, ("x",), ("up",)
    )
    transitions = RecordedTransitions(1)
    for x in 0.3 + 0.6 * rng.random(100):
        # In unit coordinates of the source.
        effect = (0.02 + 0.1 * (1.2 * x) ** 2) / 1.2
        transitions.add(np.array([x]), 0, -1.0, np.array([effect]), False)
    copies = Copies([source], np.zeros(2, dtype=np.int64), np.zeros((2, 1), dtype=np.int64), np.array([[1.0], [-1.0]]), 0.2)
    sums = CopySums.zero(2, 1, 1, 1)
    for i in range(100):
        copies.measure(transitions.states[i], 0, transitions.effects[i], sums)
    choice = prior_choice.choose_factored(copies, sums)
    assert choice.copies.tolist() == [[0]] and best_ending(copies, sums, choice, transitions) is choice


class Line(gym.Env):
    """From the middle of the line to its end at one side."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (1,)), gym.spaces.Discrete(2)

    def __init__(self, upwards):
        self.upwards = upwards

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(0.4, 0.6)
        return np.float32([self.at]), {}

    def step(self, action):
        self.at = float(np.clip(self.at + (STEP if action else -STEP), 0.0, 1.0))
        ended = self.at > GOAL if self.upwards else self.at < 1.0 - GOAL
        return np.float32([self.at]), -1.0, bool(ended), False, {}


@pytest.mark.parametrize("upwards", [True, False])
def test_values_are_bounded_from_the_side_where_the_target_ends_and_so_after_loading(upwards, tmp_path):
    env = Monitor(gym.wrappers.TimeLimit(Line(upwards), 100))
    model = FittedRMax(env, transfer=COMBREL(line_source()), seed=0)
    model.learn(150)
    prior = model.transfer.source_prior
    bound = prior.value_bound()
    [at] = model.transfer.task.sample_states.T
    order = np.argsort(at)
    assert bound is not None and (bound[order[-1]] > bound[order[0]]) == upwards
    of_bound, report = prior.candidates.describe_choice(prior.bounding), model.transfer.report()
    assert report.bounded_through == ("" if prior.bounding.same(prior.choice) else of_bound)
    assert not report.bounded_through or f"source's value there, seen through {of_bound}" in str(report)
    # All but the first episodes take the shortest way.
    assert max(env.get_episode_lengths()[3:]) <= 12
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model").transfer.source_prior
    assert loaded.bounding.same(prior.bounding)
    np.testing.assert_array_equal(loaded.value_bound(), bound)


@given(st.lists(st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(0.0, 30.0)), min_size=1, max_size=20))
def test_the_evidence_of_rewards_is_that_of_student_s_t_with_the_mean_size_as_scale(transitions):
    rewards, foretold, weights = map(np.array, zip(*transitions, strict=True))
    size = max(sum(abs(r) for r in rewards.tolist()) / len(rewards), 1e-9)
    expected = sum(-w / (w + 1.0) * np.log(1.0 + ((r - f) / size) ** 2) for r, f, w in transitions)
    assert equations.rewards_evidence(rewards, foretold, weights) == pytest.approx(expected, rel=1e-9, abs=1e-12)


WRONG = {
    "rewards": lambda right: replace(right, rewards=-right.rewards),
    "ends": lambda right: replace(right, terminated=right.next_states[:, 0] < 0.5),
}


@pytest.mark.parametrize("right_first", [True, False])
@pytest.mark.parametrize("d", [1, 2])
@pytest.mark.parametrize("wrong", WRONG)
def test_of_sources_with_the_same_effects_that_with_the_target_s_ends_and_rewards_is_taken(wrong, d, right_first):
    sources = [line_source(), WRONG[wrong](line_source())][:: 1 if right_first else -1]
    transitions = seen(d, lambda x: (x > GOAL).all())
    state = np.tile(np.where(np.eye(d) > 0, 0, -1), (2, 1))
    copies = Copies(sources, np.repeat([0, 1], d), state, np.ones((2 * d, d)), 0.2)
    sums = CopySums.zero(2 * d, 2, 2**d, d)
    for i in range(transitions.n):
        copies.measure(transitions.states[i], int(transitions.actions[i]), transitions.effects[i], sums)
    choice = prior_choice.choose_factored(copies, sums)
    assert choice.copies[0].tolist() == list(range(d)), "by effects, the first of equals"
    found = best_source(copies, sums, choice, transitions)
    assert set(copies.source[found.copies.ravel()]) == {0 if right_first else 1}
    np.testing.assert_array_equal(found.actions, choice.actions)


@pytest.mark.parametrize("wrong", WRONG)
def test_a_learner_goes_over_to_the_source_with_the_right_rewards_and_ends(wrong):
    sources = [WRONG[wrong](line_source()), line_source()]
    model = FittedRMax(gym.wrappers.TimeLimit(Line(True), 100), transfer=COMBREL(sources), seed=0).learn(300)
    prior = model.transfer.source_prior
    assert set(prior.copies.source[prior.choice.copies[prior.choice.copies >= 0]]) == {1}
    assert prior.evidence.explains_rewards() and prior.value_bound() is not None
    assert "of source 2" in model.transfer.describe_prior()
