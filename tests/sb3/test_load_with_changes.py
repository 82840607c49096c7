"""Arguments that are changed when a model is loaded are followed, or refused."""

import numpy as np
import pytest
from helpers.walk import Walk, same_parameters, small, walk_source
from stable_baselines3 import DQN

from sb3_combrel import COMBREL, MASTER, TIMBREL, FittedRMax, InterTaskMapping
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy


@pytest.fixture
def file(tmp_path):
    small(Walk(limit=100)).learn(200).save(tmp_path / "walk")
    return tmp_path / "walk"


@pytest.mark.parametrize("change", [{"gamma": 0.9}, {"max_value": 3.0}])
def test_values_follow_another_gamma_or_bound(file, change):
    loaded = FittedRMax.load(file, **change).agent
    values = loaded.planner.values.copy()
    for _ in range(20):
        loaded.planner.sweep(1000)
    np.testing.assert_allclose(values, loaded.planner.values, atol=0.01)
    assert not np.allclose(values, FittedRMax.load(file).agent.planner.values, atol=0.01)


@pytest.mark.parametrize("change", [{"model_breadth": 0.3}, {"min_weight": 0.3}, {"exploration_threshold": 3.0}])
@pytest.mark.parametrize("how", ["argument", "custom_objects"])
def test_what_is_known_follows_another_model(file, change, how):
    loaded = FittedRMax.load(file, **(change if how == "argument" else {"custom_objects": change}))
    new = small(Walk(limit=100), **change, instances=file)
    np.testing.assert_array_equal(loaded.agent.model.known, new.agent.model.known)
    np.testing.assert_allclose(loaded.agent.planner.values, new.agent.planner.values, atol=0.01)
    assert not np.allclose(loaded.agent.planner.values, FittedRMax.load(file).agent.planner.values, atol=0.01)


def test_the_same_arguments_once_more_change_nothing(file):
    assert same_parameters(FittedRMax.load(file, model_breadth=0.15, resolution=3), FittedRMax.load(file))


def test_scales_follow_other_bounds(file):
    bounds = [-1.0, 0.0], [2.0, 2.0]
    loaded, plain = FittedRMax.load(file, env=Walk(), bounds=bounds), FittedRMax.load(file)
    np.testing.assert_array_equal((loaded.policy.scales.scaling.low, loaded.policy.scales.scaling.high), bounds)
    one, other = loaded.source_instances(), plain.source_instances()
    np.testing.assert_allclose(one.states, other.states, atol=1e-9)
    actions = [each.predict(np.float32([0.5, 1.0]), deterministic=True)[0] for each in (loaded, plain)]
    assert actions == [1, 1] and loaded.learn(20).agent.model.n_instances == 220


def test_what_was_learned_of_a_source_is_learned_anew_by_other_bounds(tmp_path):
    small(transfer=COMBREL(walk_source()), bounds=([-1.0, 0.0], [1.0, 2.0])).learn(100).save(tmp_path / "walk")
    loaded = FittedRMax.load(tmp_path / "walk", bounds=([-1.5, 0.0], [1.5, 2.0]))
    assert loaded.transfer.task.scaling == loaded.policy.scales.scaling and loaded.transfer.mapping_counts() is not None


def test_more_instances_are_taken_in(file):
    loaded = FittedRMax.load(file, env=Walk(), instances=walk_source())
    assert loaded.agent.model.n_instances == 200 + len(walk_source())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_valu": 3.0}, "did you mean 'max_value'"),
        ({"max_instances": 10}, "max_instances must be at least"),
        ({"resolution": 2}, "leave out resolution, or make a new model: FittedRMax"),
        ({"transfer": COMBREL(walk_source())}, "leave out transfer, or make a new model"),
    ],
)
def test_what_cannot_be_changed_is_refused(file, change, message):
    with pytest.raises(ValueError, match=message):
        FittedRMax.load(file, **change)


def test_a_model_of_another_algorithm_is_named_without_its_suffix(tmp_path):
    DQN("MlpPolicy", Walk(), buffer_size=10).save(tmp_path / "dqn")
    with pytest.raises(ValueError, match="is a model of another algorithm"):
        FittedRMax.load(tmp_path / "dqn")


def test_the_file_of_a_model_is_found_without_its_suffix(file):
    assert small().load_instances(file).agent.model.n_instances == 200


class OwnPolicy(FittedRMaxPolicy):
    """A policy of a user's own."""


def test_a_policy_of_ones_own_does_not_hide_what_is_wrong(tmp_path):
    FittedRMax(OwnPolicy, Walk(), seed=0).save(tmp_path / "model")
    with pytest.raises(ValueError, match="is a model of another task than env: Observation spaces do not match"):
        FittedRMax.load(tmp_path / "model", env="CartPole-v1")


IDENTITY, MIRRORED = InterTaskMapping([0, 1], [0, 1]), InterTaskMapping([0, 1], [1, 0])


@pytest.mark.parametrize(
    ("method", "other"),
    [
        (lambda: COMBREL(walk_source()), COMBREL(walk_source(80))),
        (lambda: COMBREL(walk_source(), use="instances"), COMBREL(walk_source(), use="prior")),
        (lambda: COMBREL.paper(walk_source()), None),
        (lambda: TIMBREL(walk_source(), IDENTITY), TIMBREL(walk_source(), MIRRORED)),
        (lambda: {"sb3_combrel.SampleTransfer": {"source": walk_source()}}, COMBREL(walk_source())),
        (lambda: MASTER(walk_source(), n_random_steps=10), MASTER(walk_source(), n_random_steps=11)),
    ],
)
def test_a_transfer_method_may_be_given_again_and_no_other_as_what_it_has_learned_is_kept(method, other, tmp_path):
    model = small(transfer=method()).learn(30)
    model.save(tmp_path / "walk")
    assert same_parameters(FittedRMax.load(tmp_path / "walk", transfer=method()), model)
    with pytest.raises(
        ValueError, match=r"(leave it out|leave out transfer), or make a new model.*FittedRMax\(env, instances="
    ):
        FittedRMax.load(tmp_path / "walk", transfer=other)


def test_a_source_in_a_file_may_be_given_again_while_it_is_the_same(tmp_path):
    walk_source().save(tmp_path / "source.npz")
    given = {"sb3_combrel.COMBREL": {"source": str(tmp_path / "source.npz")}}
    model = small(transfer=given).learn(30)
    model.save(tmp_path / "walk")
    assert same_parameters(FittedRMax.load(tmp_path / "walk", transfer=given), model)
    walk_source(80).save(tmp_path / "source.npz")
    with pytest.raises(ValueError, match=r"^transfer must be the method that .*FittedRMax\(env, instances="):
        FittedRMax.load(tmp_path / "walk", transfer=given)
