"""A model with transfer, saved and loaded, goes on with the same mappings, compliance, source and random numbers."""

import numpy as np
import pytest
from helpers.walk import METHODS, STRIDE, Walk, learnt_on, same_parameters, small, stored, walk_source
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, MappingSet, SampleTransfer
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer.base import Transfer

MAPPING = InterTaskMapping([0, 1], [0, 1])
VARIANTS = {
    **METHODS,
    "one mapping an action": lambda: TIMBREL(walk_source(), [MAPPING, InterTaskMapping([0, None], [1, 0])]),
    "pool": lambda: TIMBREL(walk_source(), "pool", mappings="all"),
    "two sources": lambda: COMBREL([walk_source(40), walk_source(60)], use="instances"),
    "first episode": lambda: COMBREL(walk_source(), measured="first_episode"),
    "drawn": lambda: COMBREL(walk_source(), choice="drawn"),
    "set": lambda: COMBREL(walk_source(), MappingSet.injective(2, 2, 2, 2), n_neighbors=2),
    "list": lambda: COMBREL(walk_source(), [MAPPING, {"state": [0, None], "action": [1, 0]}], min_compliance=0.0),
    "few transitions": lambda: COMBREL(walk_source(), max_transitions=25, bandwidths=(0.1, 0.1, np.float64(1.0))),
}


@pytest.fixture(params=VARIANTS)
def variant(request):
    return VARIANTS[request.param]


def after_episodes(n, transfer, env=None, **kwargs):
    return small(env, transfer=transfer, **kwargs).learn(10**6, callback=StopTrainingOnMaxEpisodes(n))


def test_learning_goes_on_to_the_last_bit(variant, tmp_path):
    """Saved at an episode's end, a loaded model learns what the model itself learns when it learns on."""
    model, loaded = learnt_on(after_episodes(2, variant()), tmp_path, 60)
    assert same_parameters(model, loaded)
    assert model.agent.model.n_instances > 60
    if model.policy.transfer is not None:
        assert model.policy.transfer.mapping_counts() == loaded.policy.transfer.mapping_counts()


BY_RELEVANCE = {
    "none": lambda: None,
    "TIMBREL": lambda: TIMBREL(walk_source(), MAPPING, relevance="near"),
    "pool": lambda: TIMBREL(walk_source(), "pool", relevance=True),
    "COMBREL": lambda: COMBREL(walk_source(), relevance="near"),
    "SampleTransfer": lambda: SampleTransfer(walk_source(), min_transitions=20, relevance=True),
}


@pytest.mark.parametrize(
    ("name", "n_episodes"),
    [("TIMBREL", 3), ("none", 5), ("COMBREL", 5), *(pytest.param(name, 8, marks=pytest.mark.long) for name in BY_RELEVANCE)],
)
def test_two_halves_make_the_run_that_was_not_interrupted(name, n_episodes, tmp_path):
    """But for the planning that a call of ``learn`` begins with, which a small tolerance leaves nothing to do.

    Relevance is measured by the transitions of its last renewal, of which there may have been none, not by all so far.
    """
    given = dict(planning_tolerance=1e-10, max_backups=20_000, model_breadth=0.05, exploration_threshold=2.0)
    whole = after_episodes(n_episodes + 6, BY_RELEVANCE[name](), Walk(start=-0.5), **given)
    after_episodes(n_episodes, BY_RELEVANCE[name](), Walk(start=-0.5), **given).save(tmp_path / "half")
    halves = FittedRMax.load(tmp_path / "half", env=Walk(start=-0.5))
    halves.learn(10**6, callback=StopTrainingOnMaxEpisodes(6), reset_num_timesteps=False)
    assert halves.num_timesteps == whole.num_timesteps > 60
    np.testing.assert_array_equal(stored(halves), stored(whole))
    np.testing.assert_allclose(halves.agent.planner.values, whole.agent.planner.values, atol=1e-8)
    if name == "none":
        return
    assert halves.policy.transfer.uses() == whole.policy.transfer.uses()
    for one, other in zip(*(transferred_by(model.policy.transfer) for model in (halves, whole)), strict=True):
        np.testing.assert_array_equal(one, other)


def transferred_by(method):
    """Weights, effects and rewards of the instances that a method transfers to all pairs of the sample."""
    points = method.task.sample_states
    pairs = np.tile(np.arange(len(points)), 2), np.repeat([0, 1], len(points)), np.zeros(2 * len(points))
    found = method.transferred_to_sample(*pairs)
    there = np.arange(found.weight.shape[1]) < found.length[: 2 * len(points), None]
    return [array[: 2 * len(points)][there] for array in (found.weight, found.effect, found.reward)]


@pytest.mark.parametrize(
    ("name", "steps"), [("COMBREL", 0), ("first episode", 13), *((n, 47) for n in ("TIMBREL", "two sources", "drawn"))]
)
def test_choices_compliance_and_transferred_instances_are_the_same_at_once(name, steps, tmp_path):
    model = small(transfer=VARIANTS[name]())
    if steps:
        model.learn(steps)
    model.save(tmp_path / "model")
    ours, theirs = model.policy.transfer, FittedRMax.load(tmp_path / "model").policy.transfer
    pairs = np.arange(2 * model.agent.grid.n_points)
    np.testing.assert_array_equal(ours.choices(), theirs.choices())
    if isinstance(ours, COMBREL):
        np.testing.assert_array_equal(ours.chosen_compliance(pairs), theirs.chosen_compliance(pairs))
        assert (ours.choices() >= 0).any() == (steps == 47 or (steps > 0 and ours.measured == "online"))
    for method in (ours, theirs):
        method.changed(np.zeros((2, model.agent.grid.n_points), dtype=bool))
    for one, other in zip(transferred_by(ours), transferred_by(theirs), strict=True):
        np.testing.assert_array_equal(one, other)
    assert ours.statistics() == theirs.statistics()
    for one, other in zip(ours.sources, theirs.sources, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.rewards, other.rewards)
        assert (one.state_names, one.action_names, one.origin) == (other.state_names, other.action_names, other.origin)


def test_the_file_of_a_model_contains_the_source(tmp_path):
    path = walk_source().save(tmp_path / "source.npz")
    model = small(transfer={"sb3_combrel.COMBREL": {"source": str(path), "n_neighbors": 2}}).learn(40)
    model.save(tmp_path / "model")
    path.unlink()
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert (type(loaded.policy.transfer), loaded.policy.transfer.n_neighbors) == (COMBREL, 2)
    assert len(loaded.policy.transfer.sources[0]) == 60
    loaded.learn(20)
    loaded.save(tmp_path / "again")
    assert FittedRMax.load(tmp_path / "again").agent.model.n_instances == 60


def test_random_mappings_are_saved_and_others_are_drawn_after_loading(tmp_path):
    """What differs after loading: all pairs are modelled once more, so TIMBREL("random") draws other mappings for them."""
    model = small(transfer=TIMBREL(walk_source(), "random")).learn(60)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert loaded.policy.transfer.mapping == "random"
    np.testing.assert_array_equal(stored(loaded), stored(model))
    assert loaded.learn(30).agent.model.n_instances == 90


class Pushy(Transfer):
    """A user's own method: whatever is not known moves to the right."""

    def __init__(self, push, schedule=None):
        self.push, self.schedule = push, schedule

    def bind(self, task, rng):
        super().bind(task, rng)
        self.n_observed = 0

    def observe(self, state, action, reward, next_state, terminated):
        self.n_observed += 1

    def lowest_reward(self):
        return -1.0

    def changed(self, known):
        return self.n_observed == 0

    def transferred(self, states, actions, own_weight):
        n = len(states)
        effect = np.zeros((n, 1, self.task.n_variables))
        effect[:, :, 0] = self.push
        return TransferredInstances(
            np.ones(n, dtype=np.int64), np.ones((n, 1)), effect, np.full((n, 1), -1.0), np.zeros((n, 1), dtype=np.bool_)
        )

    def get_state(self):
        return {"n_observed": np.array([float(self.n_observed)])}

    def set_state(self, state):
        self.n_observed = int(state["n_observed"][0])


def test_a_method_of_the_users_own_is_saved_by_its_arguments(tmp_path, recwarn):
    small(transfer=Pushy(np.float64(STRIDE / 2))).learn(30).save(tmp_path / "model")
    assert not [warning for warning in recwarn if "transfer" in str(warning.message)]
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert type(loaded.policy.transfer) is Pushy
    assert (loaded.policy.transfer.push, loaded.policy.transfer.n_observed) == (STRIDE / 2, 30)
    loaded.learn(10)
    assert loaded.policy.transfer.n_observed == 40


def test_a_transfer_method_that_is_not_plain_data_must_be_passed_to_load(tmp_path):
    own = Pushy(STRIDE / 2, schedule=lambda n: n)
    model = small(transfer=own).learn(30)
    with pytest.warns(UserWarning, match=r"Pushy is not saved .*load\(\.\.\., transfer=Pushy\(\.\.\.\)\)"):
        model.save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"Pushy, which could not be saved with it: .*load\(\.\.\., transfer=\.\.\.\)"):
        FittedRMax.load(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk(), transfer=own)
    assert loaded.policy.transfer.n_observed == 30
    assert same_parameters(loaded, model)


def test_a_subclass_without_its_arguments_is_not_loaded_as_its_parent(tmp_path):
    class Mine(COMBREL):
        def __init__(self, source, secret):
            super().__init__(source)

    with pytest.warns(UserWarning, match=r"Mine is not saved .*secret"):
        small(transfer=Mine(walk_source(), 3)).learn(10).save(tmp_path / "model")
    with pytest.raises(ValueError, match="Mine"):
        FittedRMax.load(tmp_path / "model")
    with pytest.raises(ValueError, match="transfer"):
        FittedRMax.load(tmp_path / "model", transfer=None)
