"""Mappings as experts: what each does, who acts in which episode, and that the agent learns from all of it."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.agents import make_agent
from helpers.asking import bound, changed_pairs, pairs_of, transferred_to_all, transferred_to_pairs
from helpers.naive_transfer import source_of, transitions_of
from helpers.walk import GOAL, STRIDE, Walk, small, walk_source
from stable_baselines3.common.env_util import make_vec_env

from sb3_combrel import MASTER, TIMBREL, InterTaskMapping, MappingExperts, MappingSet, SourceInstances
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.methods.experts import best_by_ucb1
from sb3_combrel.transfer.methods.master import squared_errors
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.source_model import SourceModel
from sb3_combrel.transfer.source_policy import SourcePolicy

SAME = InterTaskMapping([0, 1], [0, 1])
OPPOSITE = InterTaskMapping([0, 1], [1, 0])
TASK = naive.target_task(np.random.default_rng(0).random((4, 2)), 2)


def play(method, total, steps=1, environment=0, truncated=False):
    """An episode of so many steps that returns ``total``; how many of them an expert decided, and who acted."""
    method.environment = environment
    state, decided = np.full(2, 0.5 + 0.001 * len(method._ended)), 0
    for step in range(steps):
        decided += method.action(state) is not None
        after = state + 1e-6
        method.observe(state, 0, total / steps, after, step == steps - 1 and not truncated)
        state = after
    method.end_episode(truncated)
    return decided, method._ended[-1].arm


def line_source(stride, reward_at_goal, n=400):
    """As the walk, with another stride; each step costs 1, or only the goal gives a reward."""
    at, action = np.linspace(-1.0, 0.89, n), np.arange(n) % 2
    after = np.clip(at + stride * (2 * action - 1), -1.0, 1.0)
    ends = after > GOAL
    return SourceInstances(
        np.column_stack([at, np.ones(n)]),
        action,
        np.where(ends, reward_at_goal, 0.0) if reward_at_goal else np.full(n, -1.0),
        np.column_stack([after, np.ones(n)]),
        ends,
        [-1.0, 0.0],
        [1.0, 2.0],
        2,
    )


@pytest.mark.parametrize(
    ("stride", "reward_at_goal", "gamma", "numbers", "rel"),
    [
        # A step is shorter than a cell of the grid: the finite MDP leads several steps ahead, each of them discounted.
        (0.012, 0.0, 0.98, (20, 40, 80), 0.1),
        # Rewards are bounded by much more than ways that exist give: from above, values would be several times too high.
        (STRIDE, 10.0, 0.995, range(1, 12), 0.05),
    ],
)
def test_values_are_those_of_the_steps_to_the_goal(stride, reward_at_goal, gamma, numbers, rel):
    policy = SourcePolicy(line_source(stride, reward_at_goal), gamma, 0.2)
    for n in numbers:
        q = policy.q_values(np.array([(GOAL - stride * (n - 0.5) + 1.0) / 2.0, 0.5]))
        expected = reward_at_goal * gamma ** (n - 1) if reward_at_goal else -(1.0 - gamma**n) / (1.0 - gamma)
        assert q[1] == pytest.approx(expected, rel=rel) and q[0] < q[1]


def experts_of(mappings, source=None, **arguments):
    method = bound(MappingExperts(walk_source() if source is None else source, mappings, **arguments), TASK)
    method.action(np.full(2, 0.5))
    return method


def test_an_expert_does_what_is_best_in_the_source_seen_through_its_mapping():
    exchanged_and_mirrored = InterTaskMapping([1, 0], [1, 0], [1, -1])
    method = experts_of([SAME, OPPOSITE, exchanged_and_mirrored])
    assert [expert.mapping for expert in method.experts] == [SAME, OPPOSITE, exchanged_and_mirrored]
    for at in (0.2, 0.5, 0.8):
        # The walk's goal is on the right: its action 1.
        assert method.expert_action(1, np.array([at, 0.5])) == 1 and method.expert_action(2, np.array([at, 0.5])) == 0
        assert method.expert_action(3, np.array([0.5, at])) == 0
    # Far from all data of the source; where no target variable is mapped to a source variable, it is typical.
    assert method.expert_action(1, np.array([0.5, 0.0])) is None
    assert experts_of(InterTaskMapping([0, None], [0, 1])).expert_action(1, np.array([0.4, 0.0])) == 1


def test_of_several_target_actions_one_is_drawn_and_of_none_the_next_best_source_action_is_taken():
    rng = np.random.default_rng(1)
    source, task = naive.random_source(rng, 300, 2, 3), naive.target_task(rng.random((4, 3)), 4)
    mappings = [InterTaskMapping([0, None, 1], [2, 0, 2, 0]), InterTaskMapping([None, 1, 0], [1, 1, 2, 1])]
    method = bound(MappingExperts(source, mappings), task)
    method.action(np.full(3, 0.5))
    policy, seen = SourcePolicy(source, 0.99, 0.2), set()
    for state in rng.random((60, 3)):
        for number, mapping in enumerate(mappings, start=1):
            q = policy.q_values(mapping.target_to_source(state, 2))
            best = max(set(mapping.action), key=lambda u: q[u])
            possible = [a for a in range(4) if mapping.action[a] == best]
            taken = {method.expert_action(number, state) for _ in range(25)}
            assert taken == (set(possible) if np.isfinite(q[best]) else {None})
            seen.add((best == int(q.argmax()), len(possible)))
    assert {(True, 2), (False, 2), (True, 1)} <= seen


def test_each_expert_uses_its_own_source():
    # The same walk with its actions exchanged.
    other = replace(walk_source(), actions=1 - walk_source().actions)
    method = experts_of([SAME], source=[walk_source(), other])
    assert [expert.source for expert in method.experts] == [0, 1]
    assert [method.expert_action(k, np.array([0.4, 0.5])) for k in (1, 2)] == [1, 0]


@pytest.mark.parametrize("seed", range(3))
def test_of_a_larger_set_so_many_different_ones_are_drawn(seed):
    sources = [naive.random_source(np.random.default_rng(k), 50, 2, 3) for k in (0, 1)]
    task = naive.target_task(np.zeros((1, 3)), 4)
    method = bound(MappingExperts(sources, "injective", max_experts=7), task, seed)
    assert method.n_mappings == 2 * 6 * 81
    method.action(np.zeros(3))
    numbers = np.random.default_rng(seed).choice(2 * 6 * 81, 7, replace=False).tolist()
    all_of_them = list(MappingSet.injective(2, 3, 3, 4))
    assert [tuple(expert) for expert in method.experts] == [(n // 486, all_of_them[n % 486]) for n in numbers]
    assert len({(source, mapping.state, mapping.action) for source, mapping in method.experts}) == 7


def naive_ucb1(returns, exploration):
    """Scores written out; the agent's mean is that of the later half of its episodes, rounded up."""
    n_all, least, largest = 0, math.inf, -math.inf
    for of_one in returns:
        for value in of_one:
            n_all, least, largest = n_all + 1, min(least, value), max(largest, value)
    best, chosen = -math.inf, None
    for k, of_one in enumerate(returns):
        if of_one:
            counted = of_one[-math.ceil(len(of_one) / 2) :] if k == 0 else of_one
            mean = sum(counted) / len(counted)
            score = mean + (largest - least) * exploration * math.sqrt(2.0 * math.log(n_all) / len(of_one))
            if score > best + 1e-12:
                best, chosen = score, k
    return chosen


def test_the_bandit_is_ucb1():
    rng, chosen = np.random.default_rng(0), set()
    for _ in range(300):
        returns = [rng.normal(size=rng.integers(0, 6)).tolist() for _ in range(4)]
        returns[int(rng.integers(4))].append(0.0)
        exploration = float(rng.choice([0.0, 0.2, 1.0]))
        assert best_by_ucb1(returns, exploration) == naive_ucb1(returns, exploration)
        chosen.add(naive_ucb1(returns, exploration))
    assert chosen == {0, 1, 2, 3}


def test_first_the_agent_then_each_expert_then_the_best():
    method, rng = bound(MappingExperts(walk_source(), [SAME, OPPOSITE], exploration=0.5), TASK), np.random.default_rng(0)
    returns, mean = [[], [], []], [-9.0, -5.0, -7.0]
    for episode in range(60):
        expected = episode if episode < 3 else naive_ucb1(returns, 0.5)
        total = mean[expected] + rng.normal()
        _, arm = play(method, total)
        assert arm == expected
        returns[arm].append(sum([total]))
    assert len(returns[1]) > 30 and all(len(of_one) >= 2 for of_one in returns)
    later = returns[0][len(returns[0]) // 2 :]
    np.testing.assert_allclose(method.mean_returns(), [np.mean(later), *map(np.mean, returns[1:])])
    assert method.statistics()["transfer/best_expert"] == 1


def test_an_expert_hands_over_when_it_has_taken_as_long_as_the_agent():
    method = bound(MappingExperts(walk_source(), [SAME, OPPOSITE], patience=1.5), TASK)
    assert play(method, -1.0, steps=6) == (0, 0) and play(method, -1.0, steps=20) == (9, 1)
    assert play(method, -1.0, steps=4) == (4, 2) and method.statistics()["transfer/expert_steps"] == 13
    endless = bound(MappingExperts(walk_source(), [SAME], patience=None), TASK)
    assert play(endless, -1.0, steps=6) == (0, 0) and play(endless, -1.0, steps=50) == (50, 1)


def test_steps_spent_on_finding_the_best_are_those_of_all_other_experts():
    method = bound(MappingExperts(walk_source(), [SAME, OPPOSITE], patience=None), TASK)
    for total, steps in ((-30.0, 30), (-10.0, 10), (-50.0, 50)):
        play(method, total, steps)
    figures = method.statistics()
    assert (figures["transfer/best_expert"], figures["transfer/expert_steps"]) == (1, 60)
    assert (figures["transfer/steps_to_find_mapping"], figures["transfer/expert_episodes"]) == (50, 2)
    assert (figures["transfer/agent_return"], figures["transfer/best_return"]) == pytest.approx((-30.0, -10.0))


def test_an_episode_that_was_broken_off_counts_for_nothing():
    method = bound(MappingExperts(walk_source(), [SAME]), TASK)
    play(method, -3.0, steps=3)
    state = np.full(2, 0.5)
    assert method.action(state) is not None
    method.observe(state, 0, -1.0, np.array([0.6, 0.5]), False)
    method.break_off()
    assert method.action(np.array([0.2, 0.5])) is not None
    method.observe(np.array([0.2, 0.5]), 0, -5.0, np.array([0.3, 0.5]), True)
    method.end_episode(False)
    assert [(each.arm, each.total, each.steps, each.acted) for each in method._ended[1:]] == [(1, -5.0, 1, 1)]


def test_returns_are_those_of_the_episodes_of_each_environment_and_the_agent_learns_from_every_step():
    model = small(make_vec_env(Walk, n_envs=3, seed=0), transfer=MappingExperts(walk_source())).learn(300)
    method = model.policy.transfer
    # In the buffer the last digits are rounded.
    np.testing.assert_allclose([each.total for each in method._ended], [info["r"] for info in model.ep_info_buffer], atol=1e-5)
    assert sum(each.steps for each in method._ended) == sum(info["l"] for info in model.ep_info_buffer)
    assert model.agent.model.n_instances == 300
    assert len(method.experts) == 8 and {each.arm for each in method._ended} == set(range(9))
    assert model.agent.model.transfer is None


def test_a_set_that_is_too_large_to_draw_from_is_refused():
    source = naive.random_source(np.random.default_rng(0), 50, 2, 3)
    with pytest.raises(ValueError, match=r"mappings must hold at most 9,007,199,254,740,992 mappings to draw from"):
        bound(MappingExperts(source), naive.target_task(np.zeros((1, 3)), 40))


# MASTER: random actions first, then the mapping of least mean squared error, as plain loops find it.
USES = ["instances", "prior"]
POINTS = np.random.default_rng(5).random((12, 3))


def show(method, transitions):
    for each in transitions:
        method.observe(each.state, each.action, each.reward, each.next_state, False)
    return method


def naive_error(source, mapping, transitions, predict):
    """Mean squared error of the effects that the source predicts through a mapping that uses all its variables."""
    errors = []
    for state, action, _, next_state in transitions:
        predicted = predict(tuple(mapping.target_to_source(state, source.n_variables)), mapping.action[action])
        for moved, expected in zip(next_state - state, mapping.displacement_to_target(predicted), strict=True):
            errors.append((moved - expected) ** 2)
    return sum(errors) / len(errors)


def naive_errors(source, mappings, transitions):
    model = SourceModel(stacked_instances([source]), 0.2)

    # Hundreds of mappings see the source in the same few states.
    @functools.cache
    def predict(seen, source_action):
        return model.predict(np.array([seen]), np.array([source_action])).effect[0]

    return [naive_error(source, mapping, transitions, predict) for mapping in mappings]


def parts(mapping):
    return mapping.state, mapping.action, mapping.sign


LISTED = [
    InterTaskMapping([0, None, 1], [1, 0]),
    InterTaskMapping([1, 0, None], [0, 0], [1, -1, 1]),
    InterTaskMapping([0, 1, 1], [0, 1]),
]
SETS = {
    "injective": MappingSet.injective(2, 3, 2, 2),
    "signed_surjective": MappingSet.surjective(2, 3, 2, 2, signs=True),
    "balanced": MappingSet.balanced(2, 3, 2, 2),
    "listed": LISTED,
}


@pytest.mark.parametrize("name", SETS)
def test_the_mapping_of_least_mean_squared_error_is_chosen(name):
    source, task, mappings = source_of(), naive.target_task(POINTS, 2), SETS[name]
    transitions = transitions_of(14, seed=10)
    errors = naive_errors(source, mappings, transitions)
    for use in USES:
        method = show(bound(MASTER(source, mappings, n_random_steps=14, use=use), task), transitions)
        assert parts(method.chosen) == parts(list(mappings)[int(np.argmin(errors))])
    assert sorted(errors)[1] > 1.0001 * min(errors), "no other is as good"


@pytest.mark.parametrize("use", USES)
def test_of_several_sources_the_best_mapping_to_one_is_chosen(use):
    sources, transitions = [source_of(3), source_of(4, 1, 3)], transitions_of(20)
    method = bound(MASTER(sources, "surjective", n_random_steps=20, use=use), naive.target_task(POINTS, 2))
    show(method, transitions)
    found = []
    for source in sources:
        mappings = MappingSet.surjective(source.n_variables, 3, source.n_actions, 2)
        errors = naive_errors(source, mappings, transitions)
        found.append((min(errors), parts(mappings[int(np.argmin(errors))])))
    assert parts(method.chosen) == min(found)[1]


def test_a_set_in_which_state_mappings_are_repeated():
    """Those of the paper come in pairs of equal ones."""
    source, transitions = source_of(0, 2, 3), transitions_of(8, 4, 5)
    points, different = np.random.default_rng(0).random((5, 4)), MappingSet.balanced(2, 4, 3, 5)
    errors = naive_errors(source, different, transitions)
    for use in USES:
        method = bound(MASTER(source, "paper_mountain_car", n_random_steps=8, use=use), naive.target_task(points, 5))
        assert parts(show(method, transitions).chosen) == parts(different[int(np.argmin(errors))])


def test_nothing_is_transferred_before_and_then_what_timbrel_transfers_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12)
    method = bound(MASTER(source, n_random_steps=12, use="instances", breadth=0.4), task)
    show(method, transitions[:11])
    assert method.chosen is None and (method.choices() == -1).all() and len(changed_pairs(method)) == 0
    assert not transferred_to_pairs(method, pairs_of(task), np.zeros(len(pairs_of(task)))).length.any()
    show(method, transitions[11:])
    assert changed_pairs(method).tolist() == pairs_of(task).tolist() and len(changed_pairs(method)) == 0
    given = TIMBREL(source, InterTaskMapping(*parts(method.chosen)), breadth=0.4)
    assert transferred_to_all(method, task) == transferred_to_all(bound(given, task), task)
    assert any(weights for weights, *_ in transferred_to_all(method, task))
    assert {method.candidate(c).target_action for c in set(method.choices().tolist())} == {0, 1}


def test_as_prior_it_predicts_the_effects_that_timbrel_predicts_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12)
    method = bound(MASTER(source, n_random_steps=12, use="prior"), task)
    states, actions = np.tile(POINTS, (2, 1)), np.repeat([0, 1], len(POINTS))
    show(method, transitions[:11])
    version = method.prior_version()
    assert not method.prior(states, actions).effect.any()
    show(method, transitions[11:])
    assert method.prior_version() > version
    given = show(bound(TIMBREL(source, InterTaskMapping(*parts(method.chosen)), use="prior"), task), transitions)
    np.testing.assert_allclose(method.prior(states, actions).effect, given.prior(states, actions).effect, atol=1e-12)
    assert method.prior(states, actions).effect.any()


def test_the_first_actions_are_those_of_the_seeded_generator():
    agent = make_agent(3, 2, MASTER(source_of(), n_random_steps=15), rng=3, resolution=3)
    rng, taken = np.random.default_rng(3), []
    for each in transitions_of(15):
        taken.append(agent.act(each.state))
        agent.update(each.state, taken[-1], -1.0, np.clip(each.next_state, 0.0, 1.0), False)
    assert taken == [int(rng.integers(2)) for _ in range(15)] and agent.transfer.action(np.full(3, 0.5)) is None


def test_the_targets_model_decides_for_a_prior_unless_an_argument_is_one_of_instances():
    assert small(transfer=MASTER(walk_source(), breadth=0.2)).policy.transfer.use == "instances"
    undecided = MASTER(walk_source())
    assert undecided.arguments()["use"] is None and small(transfer=undecided).policy.transfer.use == "prior"
    assert small(transfer=undecided, degree=0).policy.transfer.use == "instances"


def test_a_source_action_that_no_instance_has_is_never_the_best():
    source = source_of()
    source = replace(source, actions=np.zeros_like(source.actions))
    copies = Copies([source], np.zeros(1, dtype=np.int64), np.array([[0, 1]]), np.ones((1, 2)), 0.2)
    sums = CopySums.zero(1, copies.most_actions, 2, 2)
    for state in np.random.default_rng(0).random((10, 2)):
        copies.measure(state, 0, np.zeros(2), sums)
    errors = squared_errors(copies, sums)
    assert np.isfinite(errors[:, :, 0]).all() and np.isinf(errors[:, :, 1]).all()


def test_a_method_that_compares_no_predictions_says_so():
    report = small(transfer=MappingExperts(walk_source(), max_experts=2)).learn(40).transfer.report()
    assert report.sentence == "The method does not say how well the source explains the target; its figures may."
