"""MASTER: random actions first, then the mapping of least mean squared error, as plain loops find it."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.agents import make_agent
from helpers.asking import bound, changed_pairs, pairs_of, transferred_to_all, transferred_to_pairs
from helpers.walk import Walk, same_parameters, small, walk_source
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_combrel import MASTER, TIMBREL, FactoredMapping, FittedRMax, InterTaskMapping, MappingSet, SourceInstances
from sb3_combrel.tensorboard.callback import DashboardCallback
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_model import SourceModel

USES = ["instances", "prior"]
POINTS = np.random.default_rng(5).random((12, 3))


def source_of(seed=0, n_variables=2, n_actions=2):
    return naive.random_source(np.random.default_rng(seed), 120, n_variables, n_actions)


def transitions_of(n, n_variables, n_actions, seed=1):
    rng = np.random.default_rng(seed)
    return [naive.random_transition(rng, n_variables, n_actions) for _ in range(n)]


def show(method, transitions):
    for each in transitions:
        method.observe(each.state, each.action, each.reward, each.next_state, False)
    return method


def naive_error(source, mapping, transitions, predict):
    """Mean squared error of the effects that the source predicts through a mapping that uses all its variables."""
    errors = []
    for state, action, _, next_state in transitions:
        seen = mapping.target_to_source(state, source.n_variables)
        predicted = predict(tuple(seen), mapping.action[action])
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


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", SETS)
def test_the_mapping_of_least_mean_squared_error_is_chosen(name, seed, use):
    source, task, mappings = source_of(seed), naive.target_task(POINTS, 2), SETS[name]
    transitions = transitions_of(14, 3, 2, seed + 10)
    method = show(bound(MASTER(source, mappings, n_random_steps=14, use=use), task), transitions)
    errors = naive_errors(source, mappings, transitions)
    assert parts(method.chosen) == parts(list(mappings)[int(np.argmin(errors))])
    assert sorted(errors)[1] > 1.0001 * min(errors), "no other is as good"


@pytest.mark.parametrize("use", USES)
def test_of_several_sources_the_best_mapping_to_one_is_chosen(use):
    sources, transitions = [source_of(3, 2, 2), source_of(4, 1, 3)], transitions_of(20, 3, 2)
    method = bound(MASTER(sources, "surjective", n_random_steps=20, use=use), naive.target_task(POINTS, 2))
    show(method, transitions)
    found = []
    for source in sources:
        mappings = MappingSet.surjective(source.n_variables, 3, source.n_actions, 2)
        errors = naive_errors(source, mappings, transitions)
        found.append((min(errors), parts(mappings[int(np.argmin(errors))])))
    assert parts(method.chosen) == min(found)[1]


@pytest.mark.parametrize("use", USES)
def test_a_set_in_which_state_mappings_are_repeated(use):
    """Those of the paper come in pairs of equal ones."""
    source, transitions = source_of(0, 2, 3), transitions_of(25, 4, 5)
    points = np.random.default_rng(0).random((5, 4))
    method = bound(MASTER(source, "paper_mountain_car", n_random_steps=25, use=use), naive.target_task(points, 5))
    show(method, transitions)
    different = MappingSet.balanced(2, 4, 3, 5)
    errors = naive_errors(source, different, transitions)
    assert parts(method.chosen) == parts(different[int(np.argmin(errors))])


def test_nothing_is_transferred_before_and_then_what_timbrel_transfers_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12, 3, 2)
    method = bound(MASTER(source, n_random_steps=12, use="instances", breadth=0.4), task)
    show(method, transitions[:11])
    assert method.chosen is None and (method.choices() == -1).all()
    assert len(changed_pairs(method)) == 0
    assert not transferred_to_pairs(method, pairs_of(task), np.zeros(len(pairs_of(task)))).length.any()
    show(method, transitions[11:])
    assert changed_pairs(method).tolist() == pairs_of(task).tolist()
    assert len(changed_pairs(method)) == 0
    given = TIMBREL(source, InterTaskMapping(*parts(method.chosen)), breadth=0.4)
    assert transferred_to_all(method, task) == transferred_to_all(bound(given, task), task)
    assert any(weights for weights, *_ in transferred_to_all(method, task))
    assert {method.candidate(c).target_action for c in set(method.choices().tolist())} == {0, 1}


def test_of_several_sources_the_instances_of_the_chosen_one_are_transferred():
    # The second is the target itself, seen through a mapping.
    mapping, rng = InterTaskMapping([1, None, 0], [1, 0]), np.random.default_rng(2)
    sources, task = [source_of(3), source_of(4)], naive.target_task(POINTS, 2)
    method = bound(MASTER(sources, n_random_steps=20, use="instances", breadth=0.4), task)
    model = SourceModel(stacked_instances([sources[1]]), 0.2)
    for state in rng.random((20, 3)):
        action = int(rng.integers(2))
        seen = mapping.target_to_source(state, 2)[None]
        effect = model.predict(seen, np.array([mapping.action[action]])).effect[0]
        method.observe(state, action, -1.0, state + mapping.displacement_to_target(effect), False)
    assert parts(method.chosen) == parts(mapping)
    expected = transferred_to_all(bound(TIMBREL(sources[1], mapping, breadth=0.4), task), task)
    assert transferred_to_all(method, task) == expected
    assert any(weights for weights, *_ in expected)


def test_as_prior_it_predicts_the_effects_that_timbrel_predicts_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12, 3, 2)
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


def test_all_random_transitions_count_however_many():
    """A prior whose mapping may change later measures one in five of them from some time on."""
    method = bound(MASTER(source_of(), n_random_steps=520, use="prior"), naive.target_task(POINTS, 2))
    show(method, transitions_of(519, 3, 2))
    assert method.chosen is None and method.source_prior.sums.n.sum() == 519
    show(method, transitions_of(1, 3, 2))
    assert method.chosen is not None


@pytest.mark.parametrize("use", USES)
def test_later_transitions_change_nothing(use):
    method = bound(MASTER(source_of(), n_random_steps=8, use=use), naive.target_task(POINTS, 2))
    show(method, transitions_of(8, 3, 2))
    chosen = parts(method.chosen)
    show(method, transitions_of(200, 3, 2, seed=9))
    assert parts(method.chosen) == chosen
    assert method.statistics()["transfer/steps_to_find_mapping"] == 8
    assert method.statistics()["transfer/mapping_found"] == 1.0


def test_the_first_actions_are_those_of_the_seeded_generator():
    agent = make_agent(3, 2, MASTER(source_of(), n_random_steps=15), rng=3, resolution=3)
    rng, taken = np.random.default_rng(3), []
    for each in transitions_of(15, 3, 2):
        taken.append(agent.act(each.state))
        agent.update(each.state, taken[-1], -1.0, np.clip(each.next_state, 0.0, 1.0), False)
    assert taken == [int(rng.integers(2)) for _ in range(15)]
    assert agent.transfer.action(np.full(3, 0.5)) is None


class Permuted(gym.Wrapper):
    """MountainCar-v0 with its variables exchanged and its actions renamed: right, left, none."""

    def __init__(self):
        super().__init__(gym.make("MountainCar-v0"))
        low, high = self.env.observation_space.low[::-1], self.env.observation_space.high[::-1]
        self.observation_space = gym.spaces.Box(low.copy(), high.copy())

    def reset(self, **kwargs):
        state, info = self.env.reset(**kwargs)
        return state[::-1].copy(), info

    def step(self, action):
        state, *rest = self.env.step([2, 0, 1][action])
        return state[::-1].copy(), *rest


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("seed", range(2))
def test_it_finds_the_exchanged_variables_and_renamed_actions_of_a_mountain_car(seed, degree):
    source = SourceInstances.record(None, "MountainCar-v0", 600, seed=seed)
    model = FittedRMax(Permuted(), transfer=MASTER(source, n_random_steps=60), degree=degree, resolution=4, seed=seed)
    model.learn(80)
    method = model.policy.transfer
    assert method.use == ("prior" if degree == 1 else "instances")
    assert parts(method.chosen) == ((1, 0), (2, 0, 1), (1, 1))
    assert repr(method.chosen) == "InterTaskMapping(s0<-s1, s1<-s0; a0<-a2, a1<-a0, a2<-a1)"
    assert model.agent.statistics()["transfer/steps_to_find_mapping"] == 60


@pytest.mark.parametrize("use", USES)
def test_the_same_seed_gives_the_same_run(use):
    one, same, other = (
        small(transfer=MASTER(walk_source(), n_random_steps=20, use=use), seed=seed).learn(80) for seed in (1, 1, 2)
    )
    assert same_parameters(one, same)
    assert not same_parameters(one, other)


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("n_random_steps", [15, 50, 1000])
def test_saved_and_loaded_it_goes_on_as_it_would(use, n_random_steps, tmp_path):
    """In the middle of its random actions, and afterwards."""
    model = small(Walk(start=-0.5), transfer=MASTER(walk_source(), n_random_steps=n_random_steps, use=use))
    model.learn(10_000, StopTrainingOnMaxEpisodes(2))
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk(start=-0.5))
    method, again = model.policy.transfer, loaded.policy.transfer
    assert same_parameters(model, loaded)
    assert again.arguments().keys() == method.arguments().keys()
    assert (again.use, again.n_random_steps) == (use, n_random_steps)
    assert (method.chosen is None) == (n_random_steps == 1000)
    assert again.chosen == method.chosen
    assert again.statistics().keys() == method.statistics().keys()
    np.testing.assert_equal(again.statistics(), method.statistics())
    for each in (model, loaded):
        each.learn(each.num_timesteps + 60, reset_num_timesteps=False)
    assert same_parameters(model, loaded)
    assert again.chosen == method.chosen


def test_on_the_walk_the_mapping_is_the_identity():
    model = small(transfer=MASTER(walk_source(), n_random_steps=20)).learn(200)
    assert parts(model.policy.transfer.chosen)[:2] == ((0, 1), (0, 1))
    assert model.policy.transfer.describe_prior() == "a0: a0 on (s0, s1); a1: a1 on (s0, s1)"


@pytest.mark.parametrize("use", USES)
def test_its_report_has_its_own_figures(use):
    report = small(transfer=MASTER(walk_source(), n_random_steps=20, use=use)).learn(200).transfer.report()
    assert report.statistics["transfer/steps_to_find_mapping"] == 20
    assert report.statistics["transfer/mapping_found"] == 1.0


def test_several_environments_act_at_random_together():
    model = small(make_vec_env(Walk, n_envs=3, seed=0), transfer=MASTER(walk_source(), n_random_steps=20)).learn(120)
    assert parts(model.policy.transfer.chosen)[:2] == ((0, 1), (0, 1))
    assert model.agent.statistics()["transfer/steps_to_find_mapping"] == 20


@pytest.mark.parametrize("use", USES)
def test_it_is_shown_on_the_dashboard(use, tmp_path):
    model = small(transfer=MASTER(walk_source(), n_random_steps=90, use=use), tensorboard_log=str(tmp_path))
    model.learn(250, DashboardCallback(scalar_share=1.0), log_interval=1, tb_log_name="run")
    events = EventAccumulator(str(next(tmp_path.glob("run_*"))))
    events.Reload()
    found = [event.value for event in events.Scalars("transfer/mapping_found")]
    assert found[0] == 0.0 and found[-1] == 1.0
    assert events.Scalars("transfer/steps_to_find_mapping")[-1].value == 90.0


@pytest.mark.parametrize("value", [0, -1, 2.5, None, True, "many"], ids=repr)
def test_a_bad_number_of_random_steps_is_refused(value):
    with pytest.raises(ValueError, match="n_random_steps must be a whole number of at least 1, got"):
        MASTER(walk_source(), n_random_steps=value)


@pytest.mark.parametrize(
    "mappings", ["factored", "signed_factored", FactoredMapping((InterTaskMapping([0, 1], [0, 1]),))], ids=repr
)
def test_factored_mappings_are_refused(mappings):
    with pytest.raises(ValueError, match="mappings must be a set of which one mapping is chosen, no factored ones, got"):
        MASTER(walk_source(), mappings)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"use": "model"}, 'use must be "instances" or "prior", got \'model\''),
        ({"breadth": 0.0}, "breadth must be a number above 0, got 0.0"),
        ({"breadth_decay": 2.0}, "breadth_decay must be a number above 0 and at most 1, got 2.0"),
        ({"source_breadth": -1.0}, "source_breadth must be a number above 0, got -1.0"),
        ({"transfer_terminals": 1}, "transfer_terminals must be True or False, got 1"),
    ],
)
def test_other_arguments_out_of_range_are_refused(argument, message):
    with pytest.raises(ValueError, match=message):
        MASTER(walk_source(), **argument)


@pytest.mark.parametrize("use", USES)
def test_what_does_not_fit_the_target_is_refused(use):
    with pytest.raises(ValueError, match="state must have 2 entries"):
        small(transfer=MASTER(walk_source(), InterTaskMapping([0, None, 1], [0, 1]), use=use))
    # 12 target actions on 4 source actions, equally often: 369,600 ways.
    many = MappingSet.balanced(2, 2, 4, 12)
    with pytest.raises(ValueError, match=r"mappings must have at most 100,000 action mappings, .* got 369,600"):
        bound(MASTER(source_of(0, 2, 4), many, use=use), naive.target_task(POINTS[:, :2].copy(), 12))
    # All ways, many more, are no problem.
    method = bound(MASTER(source_of(0, 2, 4), n_random_steps=5, use=use), naive.target_task(POINTS[:, :2].copy(), 12))
    assert show(method, transitions_of(5, 2, 12)).chosen is not None


def test_as_prior_it_needs_the_local_linear_model():
    with pytest.raises(ValueError, match=r'MASTER\(use="prior"\) needs the local linear model'):
        small(transfer=MASTER(walk_source(), use="prior"), degree=0)


def test_arguments_of_instances_decide_for_instances():
    assert small(transfer=MASTER(walk_source(), breadth=0.2)).policy.transfer.use == "instances"
    undecided = MASTER(walk_source())
    assert undecided.arguments()["use"] is None
    assert small(transfer=undecided).policy.transfer.use == "prior"
    assert small(transfer=undecided, degree=0).policy.transfer.use == "instances"
