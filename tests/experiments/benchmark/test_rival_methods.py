"""Rivals as plug-ins: the search by a genetic algorithm against all mappings, Bellman errors against loops, the pair."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, show
from helpers.naive_transfer import source_of, transitions_of

from sb3_combrel import FittedRMax, MappingSet
from sb3_combrel.experiments.benchmark import rival_methods as rivals
from sb3_combrel.experiments.benchmark.command import pairs_of
from sb3_combrel.experiments.benchmark.methods import method_of
from sb3_combrel.experiments.benchmark.rival_methods import BellmanConsistent, EvolvedMapping, evolve, values_of
from sb3_combrel.transfer.methods.master import squared_errors
from sb3_combrel.transfer.source_policy import SourcePolicy

TASK = naive.target_task(np.random.default_rng(0).random((4, 3)), 2)


def after(method, n, seed=0):
    bound(method, TASK)
    for transition in transitions_of(n, seed=seed):
        show(method, transition)
    return method


def errors_of_all(method):
    """Summed squared errors of all mappings of a set, by state mapping and actions."""
    prior = method.source_prior
    errors = squared_errors(prior.copies, prior.sums)
    for mapping in MappingSet.surjective(2, 3, 2, 2):
        row = prior.copies.state.tolist().index(list(mapping.state_index))
        yield float(errors[row, np.arange(2), list(mapping.action)].sum())


def test_the_genetic_algorithm_finds_the_best_of_a_few_mappings_and_the_same_with_the_same_seed():
    method = after(EvolvedMapping(source_of(), n_random_steps=40), 40)
    prior = method.source_prior
    errors = squared_errors(prior.copies, prior.sums)
    found = errors[prior.choice.copies[:, 0], np.arange(2), prior.choice.actions[:, 0]].sum()
    everything = sorted(errors_of_all(method))
    assert len(everything) == 6 * 2**2 and found == pytest.approx(everything[0])
    first, again = (evolve(prior.copies, np.random.default_rng(3), prior.sums) for _ in range(2))
    assert first.same(again)


def test_of_many_mappings_it_judges_as_many_as_it_may_and_the_best_is_never_lost(monkeypatch):
    method = after(EvolvedMapping(source_of(), n_random_steps=40), 40)
    prior, judged = method.source_prior, []
    member = rivals.Member
    monkeypatch.setattr(rivals, "Member", lambda *parts: judged.append(parts[2]) or member(*parts))
    choice = evolve(prior.copies, np.random.default_rng(5), prior.sums)
    errors = squared_errors(prior.copies, prior.sums)
    assert rivals.JUDGED - rivals.POPULATION < len(judged) <= rivals.JUDGED
    assert errors[choice.copies[:, 0], np.arange(2), choice.actions[:, 0]].sum() == pytest.approx(min(judged))


def test_bellman_errors_are_those_of_plain_loops():
    source = source_of()
    method = after(BellmanConsistent(source, n_random_steps=30), 29)
    prior = method.source_prior
    found = method._bellman_errors(prior.copies)
    gamma = min(TASK.gamma, rivals.LARGEST_GAMMA)
    policy = SourcePolicy(source, gamma, float(method.source_breadth))
    least = policy.values.min()
    for copy, state in enumerate(prior.copies.state.tolist()):
        expected = np.zeros((2, 2))
        for s, a, reward, s_next, *_ in transitions_of(29, seed=0):

            def q(at, state=state):
                seen = np.zeros(2)
                for k in range(2):
                    # A source variable is the mean of the target variables that are mapped to it.
                    seen[k] = np.mean([at[v] for v, of in enumerate(state) if of == k])
                return [value if np.isfinite(value) else least for value in policy.q_values(seen)]

            value = reward + gamma * max(q(np.clip(s_next, 0.0, 1.0)))
            expected[a] += (value - np.array(q(s))) ** 2
        np.testing.assert_allclose(found[copy], expected, rtol=1e-6)


def test_an_action_without_data_is_worth_the_least():
    source = source_of(n=6)
    policy = SourcePolicy(source, 0.9, 0.05)
    assert (values_of(policy, np.array([[0.0, 0.0], [1.0, 1.0]])) == policy.values.min()).all()


@pytest.mark.long
@pytest.mark.parametrize("name", ["GAME", "BELLMAN"])
def test_they_are_found_by_name_and_learn(name):
    method = method_of(f"sb3_combrel.experiments.benchmark.rival_methods:{name}")
    pair = rivals.PENDULUM_CART_POLE
    source = pair.sources[0].learn(0)
    transfer = method.make(source, pair)
    model = FittedRMax(pair.make_target(), transfer=transfer, seed=0).learn(130)
    assert model.transfer.chosen is not None and model.transfer.statistics()["transfer/mapping_found"] == 1.0
    assert model.num_timesteps == 130


def test_both_tasks_of_the_pair_have_the_same_forces():
    pair = rivals.PENDULUM_CART_POLE
    with pair.make_target() as env:
        assert env.action_space.n == 3 and env.observation_space.shape == (4,)


def test_the_pair_is_found_by_name_and_another_object_is_refused():
    module = "sb3_combrel.experiments.benchmark.rival_methods"
    [found] = pairs_of([f"{module}:PENDULUM_CART_POLE"])
    assert found.name == "pendulum-cart-pole" and found.digest
    with pytest.raises(ValueError, match=f"pairs: {module}:GAME must be a Pair, got Method"):
        pairs_of([f"{module}:GAME"])
