"""Soft homomorphisms: they find mappings that are known, claim nothing of targets that do not fit, and come back as saved."""

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import bound, inside, show
from helpers.naive_transfer import random_source
from helpers.ring import Ring
from helpers.walk import Walk, same_parameters, small, walk_source

from sb3_combrel import FittedRMax, SoftHomomorphism, SourceInstances
from sb3_combrel.transfer.methods.soft_homomorphism import MAX_MAPPINGS
from sb3_combrel.transfer.methods.soft_mapping import count_mappings

SWAPPED = f.copies_mapping(1, (1, 0))


def lopsided(states, actions):
    """Effects that are not those of the mirrored source, unlike those of the oscillator."""
    return (states - [0.2, 0.6]) @ f.SLOPES.T + 2.0 * np.abs(f.PUSH[actions])


def test_swapped_variables_are_found_from_a_few_transitions():
    method = bound(SoftHomomorphism(f.oscillator_source(), mirrored=False), 2, 3)
    walked = f.walk(SWAPPED, 150)
    show(method, walked, ends=f.ends((walked[0] + walked[2])[:, ::-1]))
    state, action = method.mixture()
    assert state[0, 0, 0, 1] > 0.95 and state[0, 0, 1, 0] > 0.95
    assert action[0, 1].argmax() == 1 and action[0, 2].argmax() == 2
    assert action[0, 1].max() > 0.9 and action[0, 2].max() > 0.9
    assert [words.rsplit(" ", 1)[0] for words in method.describe().split("; ")[1:]] == [
        "a1: Down on (s1, s0)",
        "a2: Up on (s1, s0)",
    ]
    assert float(method.describe().rsplit(" ", 1)[1]) == pytest.approx(state[0, 0, 0, 1] * action[0, 2, 2], abs=0.02)
    states, actions = inside(100, 2, 3)
    predicted = method.prior(states, actions)
    expected = f.target_effects(SWAPPED, states, actions)
    assert ((predicted.effect - expected) ** 2).sum() < 0.01 * (expected**2).sum()
    assert method._claims.trust.min() >= 0.8 and predicted.weight.min() > 1.0
    assert method.statistics()["transfer/prediction_error"] < 0.1
    assert 10 <= method.statistics()["transfer/steps_to_find_mapping"] <= 150


def test_a_mirrored_variable_and_renamed_actions_are_found():
    """The target's first variable is the source's second, mirrored; its actions are the source's in another order."""
    rng = np.random.default_rng(1)
    renamed = np.array([2, 0])
    states, actions = rng.random((150, 2)), rng.integers(2, size=150)
    at = np.column_stack([states[:, 1], 1.0 - states[:, 0]])

    def pushed(states, actions):
        return lopsided(states, actions) + np.array([[0.0, 0.05], [0.0, 0.0], [0.04, -0.05]])[actions]

    effects = pushed(at, renamed[actions])
    method = bound(SoftHomomorphism(f.oscillator_source(effects=pushed)), 2, 2)
    show(method, (states, actions, np.column_stack([-effects[:, 1], effects[:, 0]])))
    state, action = method.mixture()
    assert state[0, 0, 0, 1] > 0.95 and state[0, 1, 1, 0] > 0.95
    assert action[0, [0, 1], renamed].min() > 0.85


def test_two_copies_of_the_source_are_told_apart():
    mapping = f.copies_mapping(2, (0, 2, 1, 3))
    method = bound(SoftHomomorphism(f.oscillator_source(), mirrored=False), 4, 5)
    show(method, f.walk(mapping, 300))
    state, _ = method.mixture()
    read = [tuple(copy.argmax(axis=1).tolist()) for copy in state[:, 0]]
    assert sorted(read) == [(0, 2), (1, 3)] and state[:, 0].max(axis=2).min() > 0.95
    states, actions = inside(100, 4, 5)
    expected = f.target_effects(mapping, states, actions)
    assert ((method.prior(states, actions).effect - expected) ** 2).sum() < 0.03 * (expected**2).sum()


def test_the_prior_changes_with_each_fit_and_with_nothing_else():
    method = bound(SoftHomomorphism(f.oscillator_source(200), max_transitions=40), 2, 3)
    versions = show(method, f.walk(SWAPPED, 60))
    fitted = np.flatnonzero(np.diff([0, *versions])) + 1
    expected, due = [], 10.0
    for n in range(1, 41):
        if n >= due:
            expected.append(n)
            due = n * 2**0.5
    assert fitted.tolist() == expected == [10, 15, 22, 32]
    assert method.statistics()["transfer/fits"] == 4


def test_before_the_first_fit_nothing_is_predicted():
    method = bound(SoftHomomorphism(f.oscillator_source(60)), 2, 3)
    show(method, f.walk(SWAPPED, 9))
    assert method.describe() == "a0: nothing; a1: nothing; a2: nothing"
    states, actions = inside(5, 2, 3)
    assert not any(np.any(array) for array in method.prior(states, actions))
    assert not method.changed(np.zeros((3, 3), dtype=bool))
    assert method.transferred(states, actions, np.zeros(5)).length.tolist() == [0] * 5
    with pytest.raises(ValueError, match="no mapping before the target has been seen for 10 transitions"):
        method.mixture()


def test_a_target_that_has_nothing_in_common_is_not_claimed_to_be_known():
    rng = np.random.default_rng(2)
    states, actions = rng.random((200, 2)), rng.integers(3, size=200)
    method = bound(SoftHomomorphism(f.oscillator_source()), 2, 3)
    show(method, (states, actions, 0.1 * np.sin(40.0 * states[:, ::-1])))
    assert method._claims.trust.tolist() == [0.0, 0.0, 0.0]
    assert method.prior(*inside(50, 2, 3)).weight.max() == 0.0


def test_noise_in_a_variable_that_an_action_leaves_alone_takes_no_trust():
    def effects(states, actions):
        return 0.05 * np.column_stack([actions == 1, actions == 2])

    rng = np.random.default_rng(0)
    states, actions = rng.random((200, 2)), rng.integers(3, size=200)
    moved = effects(states, actions)
    moved = np.where(moved == 0.0, 0.004 * rng.normal(size=moved.shape), moved)
    method = bound(SoftHomomorphism(f.oscillator_source(effects=effects), mirrored=False), 2, 3)
    show(method, (states, actions, moved))
    assert method._claims.trust.min() >= 0.7


def test_no_end_is_claimed_before_one_was_confirmed_and_none_where_they_are_doubted():
    source = f.oscillator_source(1500)
    method = bound(SoftHomomorphism(source, mirrored=False), 2, 3)
    show(method, f.walk(SWAPPED, 150))
    # The source's x, which ends episodes above 0.9, is the target's second variable.
    at_end, actions = np.array([[0.5, 0.93]]), np.array([0])
    assert method.prior(at_end, actions).end[0] > 0.5
    assert method.prior(at_end, actions).weight[0] == 0.0
    before = method.prior_version()
    method.observe(at_end[0], 0, -1.0, at_end[0] + f.target_effects(SWAPPED, at_end, actions)[0], True)
    assert method.prior_version() == before + 1
    assert method.prior(at_end, actions).weight[0] > 0.0
    assert method.prior(*inside(5, 2, 3)).weight.min() > 0.0
    for _ in range(2):
        # It stays for an episode where an end is predicted.
        method.observe(at_end[0], 0, -1.0, at_end[0] + f.target_effects(SWAPPED, at_end, actions)[0], False)
        method.end_episode(truncated=True)
    # Ends are believed no more, and nothing else is doubted.
    assert method.statistics()["transfer/prior_doubted"] == 0.0
    assert method.prior(at_end, actions).weight[0] == 0.0 and method.prior(*inside(5, 2, 3)).weight.min() > 0.0
    for state in inside(3, 2, 3)[0]:
        method.observe(state, 0, -1.0, state + f.target_effects(SWAPPED, state[None], actions)[0], True)
        method.end_episode(truncated=False)
    assert method.statistics()["transfer/prior_doubted"] == 1.0
    assert method.prior(*inside(5, 2, 3)).weight.max() == 0.0


def test_the_same_seed_gives_the_same_run_and_another_one_other_starts():
    runs = [bound(SoftHomomorphism(f.oscillator_source(200)), 2, 3, seed) for seed in (0, 0, 1)]
    for method in runs:
        show(method, f.walk(SWAPPED, 40))
    first, same, other = (method.get_state() for method in runs)
    assert all(np.array_equal(first[name], same[name]) for name in first)
    assert not np.array_equal(first["soft_state_logits"], other["soft_state_logits"])


@pytest.mark.parametrize("n", [0, 5, 60])
def test_what_is_restored_predicts_and_goes_on_as_if_nothing_had_happened(n):
    walked = f.walk(SWAPPED, 100)
    method = bound(SoftHomomorphism(f.oscillator_source(200)), 2, 3)
    show(method, [column[:n] for column in walked], ends=np.arange(n) % 20 == 19)
    method.end_episode(truncated=True)
    again = bound(SoftHomomorphism(**method.arguments()), 2, 3, seed=7)
    assert {name: array.shape[1:] for name, array in again.get_state().items()} == {
        name: array.shape[1:] for name, array in method.get_state().items()
    }
    again.set_state(method.get_state())
    again.rng.bit_generator.state = method.rng.bit_generator.state
    for shown in (0, 100 - n):
        for each in (method, again):
            show(each, [column[n : n + shown] for column in walked])
        for ours, theirs in zip(method.prior(*inside(20, 2, 3)), again.prior(*inside(20, 2, 3)), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert method.get_state().keys() == again.get_state().keys()
        for name, array in method.get_state().items():
            np.testing.assert_array_equal(array, again.get_state()[name])


def test_a_model_is_saved_and_loaded_with_it(tmp_path):
    path = walk_source().save(tmp_path / "source.npz")
    given = {"sb3_combrel.SoftHomomorphism": {"source": str(path), "mirrored": False, "n_starts": 2}}
    model = small(transfer=given).learn(60)
    model.save(tmp_path / "model")
    path.unlink()
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert type(loaded.policy.transfer) is SoftHomomorphism
    assert (loaded.policy.transfer.mirrored, loaded.policy.transfer.n_starts) == (False, 2)
    assert same_parameters(model, loaded)
    assert loaded.learn(40, reset_num_timesteps=False).agent.model.n_instances == 100


def test_periodic_variables_are_taken():
    rng = np.random.default_rng(0)
    env = Ring()
    states, actions = rng.random((300, 2)), rng.integers(2, size=300)
    low, high = env.observation_space.low, env.observation_space.high
    speed = np.clip(states[:, 1] + np.where(actions == 1, 0.075, -0.075), 0.0, 1.0)
    after = np.column_stack([(states[:, 0] + 0.05 * (2.0 * speed - 1.0)) % 1.0, speed])
    raw = [low + (high - low) * each for each in (states, after)]
    source = SourceInstances(raw[0], actions, -np.ones(300), raw[1], np.zeros(300, bool), low, high, 2, periodic=(True, False))
    model = FittedRMax(env, transfer=SoftHomomorphism(source), periodic=[True, False], resolution=4, seed=0).learn(120)
    assert model.policy.transfer.statistics()["transfer/prediction_error"] < 0.2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"n_copies": 0}, "n_copies must be a whole number of at least 1 or None, got 0"),
        ({"n_starts": 0}, "n_starts must be a whole number of at least 1, got 0"),
        ({"n_starts": 1.5}, "n_starts must be"),
        ({"max_transitions": 9}, "max_transitions must be a whole number of at least 10, got 9"),
        ({"mirrored": 1}, "mirrored must be True or False, got 1"),
        ({"transfer_terminals": None}, "transfer_terminals must be True or False"),
        ({"source_breadth": 0.0}, "source_breadth must be a number above 0, got 0.0"),
        ({"source_breadth": np.nan}, "source_breadth must be"),
    ],
)
def test_an_argument_out_of_its_range_is_refused_at_once(arguments, says):
    with pytest.raises(ValueError, match=says):
        SoftHomomorphism(f.oscillator_source(60), **arguments)


def test_what_does_not_fit_the_target_is_refused_when_bound():
    two = [f.oscillator_source(60)] * 2
    with pytest.raises(ValueError, match="source must be one source with SoftHomomorphism, got 2"):
        bound(SoftHomomorphism(two), 2, 3)
    with pytest.raises(ValueError, match="source must be"):
        bound(SoftHomomorphism(5), 2, 3)
    five = random_source(np.random.default_rng(0), 20, 5, 1)
    assert count_mappings(5, 5, True) == 3840 > MAX_MAPPINGS
    with pytest.raises(ValueError, match=r"at most 2,000 mappings of states, got 3,840 of 5 target to 5 .*mirrored=False"):
        bound(SoftHomomorphism(five), 5, 3)
    bound(SoftHomomorphism(five, mirrored=False), 5, 3)
    with pytest.raises(ValueError, match="degree=0"):
        FittedRMax(Walk(), transfer=SoftHomomorphism(walk_source()), degree=0)


def test_a_source_with_more_variables_than_the_target_leaves_some_out():
    """The target is the source's first variable under a push that is the source's second, held at its mean."""
    rng = np.random.default_rng(3)
    states, actions = rng.random((100, 1)), rng.integers(2, size=100)
    source = f.oscillator_source()
    mean = source.scaling.to_unit(source.states)[:, 0].mean()
    moves = f.oscillate(np.column_stack([np.full(100, mean), states[:, 0]]), actions + 1)[:, 1:]
    method = bound(SoftHomomorphism(source, mirrored=False), 1, 2)
    show(method, (states, actions, moves))
    state, action = method.mixture()
    assert state.shape == (1, 2, 2, 1) and state[0, 0, 1, 0] > 0.9
    assert action[0].argmax(axis=1).tolist() == [1, 2]
