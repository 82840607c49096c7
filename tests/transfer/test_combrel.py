"""COMBREL's choice of mappings: the vote of Algorithm 1 against a naive one, and that it finds what corresponds to what."""

from collections import Counter
from functools import cache

import numpy as np
import pytest
from helpers import naive_transfer as naive
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from combrel_envs.mountain_car_dynamics import PUSHES, step_axis
from sb3_combrel import COMBREL, FittedRMax
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.compliance import Bandwidths

BANDWIDTHS = Bandwidths(0.05, 0.05, 1.0)
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def bound(method, task, seed=0):
    method.bind(task, np.random.default_rng(seed))
    return method


def show(method, transition):
    method.observe(transition.state, transition.action, transition.reward, transition.next_state, False)


def pairs_of(task):
    return np.arange(task.n_actions * len(task.sample_states))


def supply_of(method, task):
    """What the method has for every pair, as if none had instances of its own."""
    pairs = pairs_of(task)
    supply = method.supply(pairs, np.zeros(len(pairs)), np.zeros(len(pairs), dtype=bool))
    return [
        (supply.weight[p, :n].tolist(), supply.effect[p, :n].tolist(), supply.reward[p, :n].tolist())
        for p, n in enumerate(supply.count)
    ]


def choices_of(method, task):
    """What the method chooses for every pair if none is known."""
    renewed_by(method, task)
    return method.choices()


def renewed_by(method, task):
    """The pairs that are renewed if none is known."""
    return method.renewed(np.zeros(len(pairs_of(task)), dtype=bool))


# ------------------------------------------------------------------- the vote


class NaiveVote:
    """Lines 17 to 20 of Algorithm 1, mapping by mapping."""

    def __init__(self, sources, mappings, n_neighbors):
        self.sources, self.mappings, self.k = sources, mappings, n_neighbors
        self.seen = []
        self.known = {}

    def means(self, state, action):
        """Mean compliance of each (source, mapping) with the nearest transitions of ``action``."""
        near = sorted((t for t in self.seen if t.action == action), key=lambda t: naive.distance(t.state, state))[: self.k]
        if not near:
            return {}
        return {
            (number, mapping.state, mapping.sign, mapping.action[action]): np.mean(
                [self.compliance(t, number, mapping) for t in near]
            )
            for number, of_source in enumerate(self.mappings)
            for mapping in of_source
        }

    def compliance(self, transition, number, mapping):
        """Naive, but computed once only."""
        key = (id(transition), number, mapping)
        if key not in self.known:
            self.known[key] = naive.compliance(transition, self.sources[number], mapping, BANDWIDTHS)
        return self.known[key]


def ways_of(method):
    """Each candidate of a bound method as the naive vote names it."""
    named = []
    for number, _, state_index, source_action in method._origin:
        of_source = method._sets[number]
        index = tuple(None if k < 0 else int(k) for k in of_source.state_mappings[state_index])
        named.append((number, index, tuple(int(s) for s in of_source.state_signs[state_index]), source_action))
    return named


@pytest.mark.parametrize("n_neighbors", [1, 3, 5])
def test_every_pair_gets_the_mapping_that_its_nearest_transitions_vote_for(n_neighbors):
    rng = np.random.default_rng(n_neighbors)
    sources = [naive.random_source(rng, 40, 2, 2), naive.random_source(rng, 40, 1, 3)]
    task = naive.target_task(POINTS[::5], 2)
    method = bound(COMBREL(sources, n_neighbors=n_neighbors, bandwidths=BANDWIDTHS), task)
    vote = NaiveVote(sources, [MappingSet.injective(s.n_variables, 3, s.n_actions, 2) for s in sources], n_neighbors)
    named, n_points = ways_of(method), len(task.sample_states)
    for _ in range(12):
        transition = naive.random_transition(rng, 3, 2)
        show(method, transition)
        vote.seen.append(transition)
    n_chosen, choices = 0, choices_of(method, task)
    for pair in pairs_of(task):
        means = vote.means(task.sample_states[pair % n_points], pair // n_points)
        chosen = choices[pair]
        if chosen < 0:
            assert max(means.values(), default=0.0) == 0.0
        else:
            n_chosen += 1
            assert means[named[chosen]] == pytest.approx(max(means.values()), rel=1e-9)
    assert n_chosen > 0
    for state in rng.random((20, 3)):
        method.supply_at(state, np.zeros(2))
        for action, chosen in enumerate(method._choice_at):
            means = vote.means(state, action)
            assert (chosen < 0) == (max(means.values()) == 0.0)
            assert chosen < 0 or means[named[chosen]] == pytest.approx(max(means.values()), rel=1e-9)


def test_the_chosen_mapping_translates_at_grid_points_and_at_exact_states():
    rng = np.random.default_rng(5)
    source = naive.random_source(rng, 200, 2, 2)
    task = naive.target_task(POINTS, 2)
    method = bound(COMBREL(source, breadth=0.2, bandwidths=BANDWIDTHS), task)
    for _ in range(30):
        show(method, naive.random_transition(rng, 3, 2))
    named, pairs, n_transferred = ways_of(method), pairs_of(task), 0
    own = rng.uniform(0.0, 1.2, len(pairs))
    method.renewed(own >= 1.0)
    supply = method.supply(pairs, own, own >= 1.0)
    for pair in pairs:
        chosen, expected = method.choices()[pair], []
        if chosen >= 0 and own[pair] < 1.0:
            _, index, sign, source_action = named[chosen]
            state = task.sample_states[pair % len(POINTS)]
            drawn_from = [(source, InterTaskMapping(index, [source_action], sign), 0)]
            expected = naive.transferred(state, own[pair], drawn_from, task, 0.2)
        n = supply.count[pair]
        assert n == len(expected)
        np.testing.assert_allclose(supply.weight[pair, :n], [e[0] for e in expected], rtol=1e-9)
        np.testing.assert_allclose(supply.effect[pair, :n], np.array([e[1] for e in expected]).reshape(n, 3), atol=1e-12)
        n_transferred += n > 0
    assert n_transferred > 20
    # At a sample state itself, the vote and the supply are those of the grid point.
    method.end_episode(False)
    renewed_by(method, task)
    for point in range(len(POINTS)):
        at = method.supply_at(POINTS[point], np.zeros(2))
        on_grid = method.supply(point + len(POINTS) * np.arange(2), np.zeros(2), np.zeros(2, dtype=bool))
        for action in range(2):
            n = at.count[action]
            assert n == on_grid.count[action]
            np.testing.assert_array_equal(at.effect[action, :n], on_grid.effect[action, :n])


def test_renewed_names_exactly_the_pairs_whose_choice_changed():
    rng = np.random.default_rng(1)
    source, task = naive.random_source(rng, 100, 2, 2), naive.target_task(POINTS, 2)
    method = bound(COMBREL(source, bandwidths=BANDWIDTHS), task)
    assert len(renewed_by(method, task)) == 0
    choice, supply, n_renewed, n_waited = method.choices(), supply_of(method, task), 0, 0
    for n in range(60):
        show(method, naive.random_transition(rng, 3, 2))
        renewed = renewed_by(method, task)
        assert sorted(renewed) == np.flatnonzero(method.choices() != choice).tolist()
        if n > 10 and len(renewed) == 0:
            n_waited += 1  # the more it has seen, the longer changes wait for each other
            continue
        now = supply_of(method, task)
        assert all(now[pair] == supply[pair] for pair in np.setdiff1d(pairs_of(task), renewed))
        choice, supply, n_renewed = method.choices(), now, n_renewed + len(renewed)
    assert n_renewed > 40 and n_waited > 20
    show(method, naive.random_transition(rng, 3, 2))
    method.end_episode(False)
    renewed = renewed_by(method, task)
    assert sorted(renewed) == np.flatnonzero(method.choices() != choice).tolist() != [], "an episode's end waits for nothing"
    assert len(renewed_by(method, task)) == 0


def test_what_changed_and_changed_back_is_not_renewed():
    rng = np.random.default_rng(1)
    task = naive.target_task(POINTS, 2)
    one, other = (bound(COMBREL(naive.random_source(np.random.default_rng(9), 60, 2, 2)), task) for _ in range(2))
    each = []
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        show(one, transition)
        show(other, transition)
        one.end_episode(False)
        each.append(renewed_by(one, task))
    at_once = renewed_by(other, task)
    assert sorted(at_once) == np.flatnonzero(other.choices() >= 0).tolist()
    assert set(at_once) <= set(np.concatenate(each))
    np.testing.assert_array_equal(one.choices(), other.choices())


def test_for_known_pairs_no_vote_is_held():
    """And what only they would hear is not measured. An instance that gives way can make a pair unknown again."""
    rng = np.random.default_rng(3)
    task = naive.target_task(POINTS, 2)
    lazy, eager = (bound(COMBREL(naive.random_source(np.random.default_rng(9), 60, 2, 2)), task) for _ in range(2))
    known = np.tile(POINTS[:, 0] < 0.9, 2)
    for _ in range(60):
        transition = naive.random_transition(rng, 3, 2)
        show(lazy, transition)
        show(eager, transition)
    assert sorted(lazy.renewed(known)) == sorted(set(renewed_by(eager, task)) - set(np.flatnonzero(known)))
    assert (lazy.choices()[known] == -1).all()
    assert 0 < lazy._ballots.measured.sum() < eager._ballots.measured.sum()
    lazy.end_episode(False)
    np.testing.assert_array_equal(choices_of(lazy, task), eager.choices())


def test_without_transitions_nothing_is_transferred():
    task = naive.target_task(POINTS, 2)
    method = bound(COMBREL(naive.random_source(np.random.default_rng(0), 100, 2, 2), breadth=1.0), task)
    assert not any(weights for weights, _, _ in supply_of(method, task))
    assert not method.supply_at(POINTS[0], np.zeros(2)).count.any()


def test_measured_in_the_first_episode_nothing_is_transferred_before_it_ends_and_nothing_changes_after():
    rng = np.random.default_rng(2)
    source, task = naive.random_source(rng, 200, 2, 2), naive.target_task(POINTS, 2)
    paper = bound(COMBREL(source, measured="first_episode", bandwidths=BANDWIDTHS), task)
    online = bound(COMBREL(source, measured="online", bandwidths=BANDWIDTHS), task)
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        show(paper, transition)
        show(online, transition)
        assert len(renewed_by(paper, task)) == 0
        assert not paper.supply_at(transition.state, np.zeros(2)).count.any()
    assert not any(weights for weights, _, _ in supply_of(paper, task))
    assert len(renewed_by(online, task)) > 0
    assert any(weights for weights, _, _ in supply_of(online, task))
    paper.end_episode(False)
    assert len(renewed_by(paper, task)) > 0
    at_its_end = supply_of(paper, task)
    assert at_its_end == supply_of(online, task)
    np.testing.assert_array_equal(paper.choices(), online.choices())
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        show(paper, transition)
        show(online, transition)
    assert len(renewed_by(paper, task)) == 0 < len(renewed_by(online, task))
    assert supply_of(paper, task) == at_its_end != supply_of(online, task)


def test_no_more_transitions_vote_than_allowed():
    rng = np.random.default_rng(2)
    method = bound(COMBREL(naive.random_source(rng, 50), max_transitions=7), naive.target_task(POINTS, 2))
    for _ in range(20):
        show(method, naive.random_transition(rng, 3, 2))
    assert method.statistics()["transfer/target_transitions"] == 7


def test_where_episodes_fail_the_transferred_instances_fade():
    rng = np.random.default_rng(2)
    source, task = naive.random_source(rng, 200, 2, 2), naive.target_task(POINTS, 2)
    fading, steady = (bound(COMBREL(source, fading=f, bandwidths=BANDWIDTHS), task) for f in (0.5, 1.0))
    narrow = bound(COMBREL(source, breadth=0.15, bandwidths=BANDWIDTHS), task)
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        for method in (fading, steady, narrow):
            show(method, transition)
    for method in (fading, steady, narrow):
        renewed_by(method, task)
    before = supply_of(fading, task)
    fading.end_episode(False)
    assert supply_of(fading, task) == before and len(renewed_by(fading, task)) == 0
    for method in (fading, steady):
        method.end_episode(True)
    assert supply_of(steady, task) == before
    assert supply_of(fading, task) == supply_of(narrow, task) != before
    assert renewed_by(fading, task).tolist() == pairs_of(task).tolist()


# ----------------------------------------------------- what it finds by itself


@cache
def mountain_car(n, seed, n_axes=1):
    """Single steps of Mountain Car from states all over its space."""
    rng = np.random.default_rng(seed)
    low, high = np.repeat([-1.2, -0.07], n_axes), np.repeat([0.6, 0.07], n_axes)
    states = rng.uniform(low, high, (n, 2 * n_axes))
    actions = rng.integers(len(PUSHES[n_axes]), size=n)
    after = np.empty_like(states)
    for i in range(n):
        for axis in range(n_axes):
            push = PUSHES[n_axes][actions[i]][axis]
            after[i, [axis, n_axes + axis]] = step_axis(states[i, axis], states[i, n_axes + axis], push)
    ends = (after[:, :n_axes] >= 0.5).all(axis=1)
    return SourceInstances(states, actions, -np.ones(n), after, ends, low, high, len(PUSHES[n_axes]))


def changed(source, columns=slice(None), mirror=False, actions=None):
    """The same steps with the variables in another order, or mirrored in their ranges, and other numbers for the actions."""
    units, ends = ((x - source.low) / (source.high - source.low) for x in (source.states, source.next_states))
    units, ends = (1.0 - units, 1.0 - ends) if mirror else (units, ends)
    d = source.n_variables
    numbers = source.actions if actions is None else np.array(actions)[source.actions]
    return SourceInstances(
        units[:, columns],
        numbers,
        source.rewards,
        ends[:, columns],
        source.terminated,
        np.zeros(d),
        np.ones(d),
        source.n_actions,
    )


def choices_after(method, target, resolution=8):
    """What the method has chosen after it has seen the target: for each action (source, state, sign, source action)s."""
    d = target.n_variables
    axes = [np.linspace(0.05, 0.95, resolution)] * d
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    task = naive.target_task(points, target.n_actions)
    bound(method, task)
    starts, ends = ((x - target.low) / (target.high - target.low) for x in (target.states, target.next_states))
    for i in range(len(target)):
        show(method, naive.Transition(starts[i], int(target.actions[i]), float(target.rewards[i]), ends[i]))
    named = ways_of(method)
    return [[named[c] for c in row if c >= 0] for row in choices_of(method, task).reshape(target.n_actions, -1)]


def share(chosen, fits):
    """The part of the choices, over all actions, that ``fits(target action, choice)``."""
    hits = [fits(action, choice) for action, row in enumerate(chosen) for choice in row]
    assert len(hits) > 100
    return np.mean(hits)


def test_a_source_that_is_the_target_is_recognized():
    chosen = choices_after(COMBREL(mountain_car(1000, 0)), mountain_car(400, 1))
    assert share(chosen, lambda action, choice: choice[1] == (0, 1)) > 0.95
    assert share(chosen, lambda action, choice: choice[1] == (0, 1) and choice[3] == action) > 0.75


def test_variables_and_actions_in_another_order_are_found():
    source = changed(mountain_car(1000, 0), columns=[1, 0], actions=[2, 0, 1])
    chosen = choices_after(COMBREL(source), mountain_car(400, 1))
    assert share(chosen, lambda action, choice: choice[1] == (1, 0)) > 0.95
    assert share(chosen, lambda action, choice: choice[1] == (1, 0) and choice[3] == [2, 0, 1][action]) > 0.75


@pytest.mark.parametrize("mirror", [False, True])
def test_a_mirrored_source_is_found_among_mappings_with_signs(mirror):
    """The valley lies near the middle of the range, so a mirrored car differs little from a plain one."""
    source = changed(mountain_car(1000, 0), mirror=mirror)
    mappings = MappingSet.injective(2, 2, 3, 3, signs=True)
    chosen = choices_after(COMBREL(source, mappings), mountain_car(400, 1))
    sign = (-1, -1) if mirror else (1, 1)
    for action, row in enumerate(chosen):
        [(most_frequent, n), (_, n_next)] = Counter(choice[1:] for choice in row).most_common(2)
        assert most_frequent == ((0, 1), sign, action)
        assert n > 2 * n_next


def test_of_several_sources_the_one_that_fits_is_chosen():
    sources = [noise(0), mountain_car(1000, 0), noise(1)]
    chosen = choices_after(COMBREL(sources), mountain_car(400, 1))
    assert share(chosen, lambda action, choice: choice[0] == 1) > 0.95


def test_each_action_of_the_larger_car_gets_the_axis_that_it_drives():
    """East and West act like Right and Left on x; from y's point of view they do nothing. North and South: vice versa."""
    chosen = choices_after(COMBREL(mountain_car(1000, 0)), mountain_car(1500, 2, 2), resolution=4)
    along_x, along_y = (0, None, 1, None), (None, 0, None, 1)
    fitting = [
        {(along_x, 0), (along_y, 0)},
        {(along_x, 1), (along_y, 0)},
        {(along_x, 2), (along_y, 0)},
        {(along_y, 1), (along_x, 0)},
        {(along_y, 2), (along_x, 0)},
    ]
    for action, row in enumerate(chosen):
        by_number = Counter((choice[1], choice[3]) for choice in row).most_common(2)
        assert {way for way, _ in by_number} == fitting[action]
        assert sum(n for _, n in by_number) > 0.6 * len(row)


# --------------------------------------------------------------------- learning


def noise(seed, n=500):
    """A source that has nothing to do with any task: from anywhere to somewhere near."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, 2))
    after = np.clip(states + 0.1 * rng.normal(size=(n, 2)), 0.0, 1.0)
    return SourceInstances(
        states, rng.integers(3, size=n), -np.ones(n), after, np.zeros(n, dtype=bool), np.zeros(2), np.ones(2), 3
    )


class Episodes(BaseCallback):
    """The lengths of episodes; ends the learning after ``n`` of them."""

    def __init__(self, n):
        super().__init__()
        self.n = n
        self.lengths = []

    def _on_step(self):
        self.lengths += [info["episode"]["l"] for info in self.locals["infos"] if "episode" in info]
        return len(self.lengths) < self.n


LIMIT = 500


def learned(transfer, seed, n_episodes):
    env = make_vec_env("combrel/MountainCar2D-v0", seed=seed, env_kwargs=dict(max_episode_steps=LIMIT))
    model = FittedRMax(env, transfer=transfer, model_breadth=1 / 16, resolution=4, seed=seed)
    episodes = Episodes(n_episodes)
    model.learn(10**6, callback=episodes)
    return model, np.array(episodes.lengths)


def test_a_source_that_is_the_target_saves_the_exploration():
    for seed in range(2):
        _, with_transfer = learned(COMBREL(mountain_car(1000, 0)), seed, 3)
        _, without = learned(None, seed, 3)
        assert with_transfer.max() < 250
        assert with_transfer.sum() < without.sum() * 3 / 4


@pytest.mark.parametrize("seed", range(3))
def test_a_source_that_has_nothing_to_do_with_the_target_does_not_hold_learning_up_for_long(seed):
    _, with_transfer = learned(COMBREL(noise(seed)), seed, 10)
    _, without = learned(None, seed, 10)
    assert with_transfer[-5:].max() < 250
    assert with_transfer.sum() < 1.2 * without.sum()


IDENTITY = {"state": [0, 1], "action": [0, 1, 2]}


@pytest.mark.parametrize(
    "arguments",
    [
        {"mappings": "all"},
        {"mappings": "surjective"},
        {"mappings": "balanced"},
        {"mappings": IDENTITY},
        {"mappings": [IDENTITY, InterTaskMapping([1, 0], [0, 1, 2])]},
        {"mappings": MappingSet.injective(2, 2, 3, 3, signs=True)},
        {"measured": "first_episode"},
        {"n_neighbors": 1},
        {"choice": "drawn", "voting_radius": 0.3},
        {"n_neighbors": 10, "max_transitions": 50},
        {"relevance": True, "relevance_fraction": 0.3},
        {"relevance": True, "measured": "first_episode"},
        {"believe_terminal": False, "breadth": 0.2, "fading": 1.0, "bandwidths": (0.02, 0.0002, 1.0)},
    ],
    ids=str,
)
def test_every_variant_reaches_the_goal_and_transfers(arguments):
    model, lengths = learned(COMBREL(mountain_car(1000, 0), **arguments), 0, 2)
    assert lengths[1] < LIMIT
    transfer = model.policy.transfer
    counts = transfer.mapping_counts()
    assert sum(n for _, n in counts) > 20
    assert counts == sorted(counts, key=lambda entry: -entry[1])
    figures = model.policy.statistics()
    assert figures["transfer/uses"] == sum(n for _, n in counts)
    assert 0.0 <= figures["transfer/choice_entropy"] <= np.log(figures["transfer/distinct_mappings"]) + 1e-9
    assert figures["transfer/target_transitions"] <= lengths.sum() + 1


def test_with_relevance_the_instances_that_the_target_contradicts_come_last():
    """Half of the source's instances are from the target, the other half say that nothing ever moves."""
    good = mountain_car(400, 0)
    still = SourceInstances(
        np.vstack([good.states, good.states + 1e-6]),
        np.tile(good.actions, 2),
        np.tile(good.rewards, 2),
        np.vstack([good.next_states, good.states + 1e-6]),
        np.zeros(800, dtype=bool),
        good.low,
        good.high,
        3,
    )
    target = mountain_car(300, 1)
    task = naive.target_task(np.random.default_rng(0).uniform(0.1, 0.9, (100, 2)), 3)
    stillness = {}
    for by_relevance in (False, True):
        method = bound(COMBREL(still, IDENTITY, relevance=by_relevance), task)
        starts, ends = ((x - target.low) / (target.high - target.low) for x in (target.states, target.next_states))
        for i in range(len(target)):
            show(method, naive.Transition(starts[i], int(target.actions[i]), -1.0, ends[i]))
        renewed_by(method, task)
        effects = np.array([effect for _, of_pair, _ in supply_of(method, task) for effect in of_pair])
        stillness[by_relevance] = np.mean(np.abs(effects).max(axis=1) == 0.0)
    assert stillness[False] > 0.4
    assert stillness[True] < 0.1
