"""What users write: methods and mappings by name, and whether instances or a prior are transferred where nothing says so."""

import re

import numpy as np
import pytest
from helpers import factored as f
from helpers.agents import make_agent
from helpers.asking import bound, changed_pairs, transferred_to_pairs
from helpers.dashboard import NamedWalk
from helpers.naive_transfer import target_task
from helpers.own_method import Mine
from helpers.walk import OBSERVATIONS, Walk, same_parameters, small, walk_source
from stable_baselines3.common.env_util import make_vec_env

import sb3_combrel
from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances, check_prior, check_transferred
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import make_transfer

SOURCE = f.oscillator_source(60)


@pytest.fixture
def path(tmp_path):
    return str(walk_source().save(tmp_path / "source.npz"))


def test_a_dict_names_the_class_with_its_package_its_module_or_alone(path):
    arguments = {"mappings": "surjective", "n_random_steps": 7}
    for written in ("MASTER", "sb3_combrel.MASTER", "sb3_combrel.transfer.methods.elsewhere.MASTER"):
        made = make_transfer({written: {"source": path, **arguments}})
        assert type(made) is sb3_combrel.MASTER and {name: getattr(made, name) for name in arguments} == arguments


def test_a_method_of_ones_own_is_imported_from_where_the_name_says():
    for written in ("helpers.own_method.Mine", "helpers.own_method:Mine"):
        made = make_transfer({written: {"reward": -3.0}})
        assert type(made) is Mine and made.reward == -3.0
    assert type(make_transfer(Mine)) is Mine


def test_a_name_that_is_wrong_is_refused_with_those_that_are_known():
    public = [each for each in sb3_combrel.__all__ if isinstance(getattr(sb3_combrel, each), type)]
    methods = [each for each in public if issubclass(getattr(sb3_combrel, each), Transfer)]
    for wrong, close in {"MASTERR": "MASTER", "nowhere.COMBREL": "COMBREL", "sb3_combrel.COMBRELL": "COMBREL", "": ""}.items():
        with pytest.raises(ValueError, match=f"{wrong!r}, which is no transfer method; known are") as error:
            make_transfer({wrong: {}})
        known = ", ".join(f"sb3_combrel.{each}" for each in sorted(methods))
        assert str(error.value).endswith(known + (f"; did you mean {close!r}?" if close else ""))


def test_a_file_in_place_of_a_method_is_told_to_be_its_source():
    with pytest.raises(ValueError, match=r"the source of a method, transfer=COMBREL\('steps/source.npz'\)$"):
        make_transfer("steps/source.npz")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"COMBREL": {}, "TIMBREL": {}}, "one entry, .* got .'COMBREL', 'TIMBREL'"),
        ({}, "one entry"),
        ({"sb3_combrel.FittedRMax": {}}, "must be a transfer method"),
        ({"COMBREL": {"source": SOURCE, "n_neighbors": 0}}, "n_neighbors must be .*0"),
        (7, "transfer must be .*7"),
    ],
    ids=str,
)
def test_whatever_names_no_method_is_refused(given, says):
    with pytest.raises(ValueError, match=says):
        make_transfer(given)


BY_NUMBER = InterTaskMapping((0, 1), (0, 1))
BY_NAME = InterTaskMapping({"place": "place", "height": "height"}, {"back": "back", "forth": "forth"})
AS_DICT = {"state": {"place": "place", "height": "height"}, "action": {"back": "back", "forth": "forth"}}


@pytest.fixture(scope="module")
def source():
    return SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)


@pytest.mark.parametrize("method", [TIMBREL, COMBREL])
def test_by_name_and_by_number_are_the_same(method, source, tmp_path):
    given = {"copies": [AS_DICT]}, FactoredMapping([BY_NAME]), FactoredMapping([BY_NUMBER])
    transfers = [method(source, mapping, use="prior") for mapping in given]
    ours, *others = (small(NamedWalk(), transfer=each).learn(40) for each in transfers)
    assert all(same_parameters(ours, theirs) for theirs in others)
    ours.save(tmp_path / "model")
    # Names of the target are not needed any more.
    assert same_parameters(ours, FittedRMax.load(tmp_path / "model", custom_objects={"_names": {}}))


def test_a_target_without_names_is_named_in_the_error(source):
    with pytest.raises(
        ValueError, match="names of the target's variables, s0, s1, got 'place'; a task that names none has s0"
    ):
        small(transfer=TIMBREL(source, BY_NAME))
    given = small(
        transfer=TIMBREL(source, BY_NAME), policy_kwargs=dict(state_names=["place", "height"], action_names=["back", "forth"])
    )
    assert given.transfer.mapping == BY_NUMBER


DECIDED = {0: ("instances", "injective"), 1: ("prior", "signed_factored")}


def decision(transfer):
    return transfer.use, transfer.mappings


@pytest.mark.parametrize("degree", DECIDED)
def test_the_targets_model_decides_and_the_decision_is_saved(degree, tmp_path):
    given = COMBREL(walk_source())
    model = small(degree=degree, transfer=given).learn(20)
    assert decision(model.policy.transfer) == DECIDED[degree]
    # What was given is a description, which serves models of the other degree as well.
    assert (given.arguments()["use"], given.arguments()["mappings"]) == (None, None)
    assert decision(small(degree=1 - degree, transfer=given).policy.transfer) == DECIDED[1 - degree]
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert decision(loaded.policy.transfer) == DECIDED[degree]
    arguments = loaded.policy.transfer.arguments()
    assert (arguments["use"], arguments["mappings"]) == DECIDED[degree] and same_parameters(loaded, model)


OF_INSTANCES = {
    "n_neighbors": 4,
    "neighbors": "state_action",
    "choice": "drawn",
    "neighbor_radius": 0.3,
    "measured": "first_episode",
    "min_compliance": 0.5,
    "min_evidence": 0.0,
    "breadth": 0.2,
    "breadth_decay": 1.0,
    "relevance": True,
    "relevance_fraction": 0.3,
    "bandwidths": np.array([0.1, 0.1, 1.0]),
}


@pytest.mark.parametrize("name", OF_INSTANCES)
def test_arguments_of_instances_mean_instances(name):
    transfer = COMBREL(walk_source(), **{name: OF_INSTANCES[name]})
    assert decision(transfer) == DECIDED[0] == (transfer.arguments()["use"], transfer.arguments()["mappings"])


def test_arguments_of_both_and_defaults_leave_it_open():
    given = dict(max_transitions=50, transfer_terminals=False, source_breadth=0.2, n_neighbors=3)
    for degree, decided in DECIDED.items():
        assert decision(small(degree=degree, transfer=COMBREL(walk_source(), **given)).policy.transfer) == decided


@pytest.mark.parametrize(
    ("mappings", "use"),
    [
        *[("injective", "instances"), ("signed_all", "instances"), ({"state": [0, 1], "action": [0, 1]}, "instances")],
        *[("factored", "prior"), ("signed_factored", "prior")],
        (FactoredMapping([{"state": [0, 1], "action": [0, 1]}]), "prior"),
    ],
    ids=str,
)
def test_mappings_say_what_is_transferred(mappings, use):
    assert decision(COMBREL(walk_source(), mappings)) == (use, mappings)


def test_the_papers_settings():
    transfer = COMBREL.paper(walk_source())
    assert decision(transfer) == DECIDED[0]
    assert (transfer.measured, transfer.n_neighbors, transfer.breadth_decay) == ("first_episode", 3, 1.0)
    assert (transfer.min_compliance, transfer.min_evidence) == (0.0, 0.0)
    other = COMBREL.paper(walk_source(), "all", n_neighbors=5)
    assert (other.use, other.mappings, other.n_neighbors, other.measured) == ("instances", "all", 5, "first_episode")


# Transfer methods of a user's own: instances, or decided actions; what they return is checked.
def test_by_default_it_is_asked_for_everything_after_each_transition():
    task = target_task(np.random.default_rng(0).random((7, 2)), 3)
    method = bound(Mine(), task)
    assert changed_pairs(method).tolist() == list(range(21))
    method.observe(np.zeros(2), 1, -1.0, np.array([0.1, 0.0]), False)
    assert changed_pairs(method).tolist() == list(range(21))
    found = transferred_to_pairs(method, np.array([0, 8, 20]), np.array([0.0, 0.5, 1.0]))
    assert found.length.tolist() == [1, 1, 0]
    np.testing.assert_array_equal(found.effect[:, 0], [[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]])
    assert method.get_state() == {} and method.statistics() == {} and method.lowest_reward() == 0.0


@pytest.mark.parametrize("changed", [None, 1, np.ones(3, dtype=np.bool_), np.ones((2, 2))])
def test_what_has_changed_is_said_by_bools(changed, monkeypatch):
    monkeypatch.setattr(Mine, "changed", lambda self, known: changed)
    with pytest.raises(ValueError, match=r"Mine\.changed must return True, False or an array of bools of shape \(2, \d+\)"):
        small(degree=0, transfer=Mine()).learn(5)


def one_row(**changes):
    row = TransferredInstances(
        np.ones(1, dtype=np.int64), np.ones((1, 2)), np.zeros((1, 2, 3)), np.zeros((1, 2)), np.zeros((1, 2), dtype=np.bool_)
    )
    return row._replace(**changes)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (None, "Mine must return TransferredInstances, got None"),
        (one_row(weight=[[1.0, 1.0]]), "weight of type list; it must be a C-contiguous array of float64"),
        (one_row(weight=np.ones(2)), r"weight of shape \(2,\); it must be"),
        (one_row(effect=np.zeros((3, 2, 1)).T), "effect of type float64; it must be a C-contiguous"),
        (one_row(effect=np.zeros((1, 2, 2))), r"with 3 state variables it must be \(1, 2, 3\)"),
        (one_row(length=np.zeros(0, dtype=np.int64)), r"length of shape \(0,\)"),
        (TransferredInstances.empty(0, 3, 2), "returned 0 rows, but was asked for 1"),
        (one_row(length=np.array([-1])), "length=-1 for row 0; it must be from 0 to 2"),
        (one_row(length=np.array([3])), "length=3 for row 0; it must be from 0 to 2"),
        (one_row(weight=np.array([[0.0, 1.0]])), "must be finite and above 0"),
        (one_row(weight=np.array([[np.nan, 1.0]])), "must be finite and above 0"),
        (one_row(weight=np.full((1, 2), 1e-6)), "add up to 1e-06 for row 0, with 0.25 .* threshold of 1,"),
        (one_row(reward=np.full((1, 2), np.nan)), "an effect or a reward that is not finite for row 0"),
        (one_row(effect=np.full((1, 2, 3), np.inf)), "an effect or a reward that is not finite for row 0"),
    ],
)
def test_whatever_breaks_the_contract_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        check_transferred(given, Mine(), np.full(1, 0.25), 3, 1.0)


def test_whatever_keeps_the_contract_is_taken():
    check_transferred(one_row(), Mine(), np.zeros(1), 3, 1.0)
    check_transferred(one_row(weight=np.array([[0.75, np.nan]])), Mine(), np.full(1, 0.25), 3, 1.0)
    check_transferred(one_row(length=np.zeros(1, dtype=np.int64), weight=np.zeros((1, 2))), Mine(), np.zeros(1), 3, 1.0)
    check_transferred(TransferredInstances.empty(5, 3), Mine(), np.zeros(2), 3, 1.0)


def predicted(effect=(0.1, 0.0), weight=(1.0, 0.0), n=2):
    return PriorPredictions(*(np.tile(row, (n, 1)) for row in (effect, weight)))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (None, "Mine.prior must return PriorPredictions, got None"),
        (predicted(effect=(0.0, 0.0, 0.0)), r"effect of shape \(2, 3\); it must be \(2, 2\)"),
        (PriorPredictions([[0.1, 0.0]] * 2, [[1.0, 0.0]] * 2), "effect that is no array of floats, got"),
        (predicted(n=1), r"effect of shape \(1, 2\); it must be \(2, 2\)"),
        (predicted(effect=(np.nan, 0.0)), r"effect \[nan  0.\] for row 0; it must be finite"),
        (predicted(weight=(np.inf, 1.0)), r"weight \[inf  1.\] for row 0; it must be finite, and at least 0"),
        (predicted(weight=(1.0, -1.0)), r"weight \[ 1. -1.\] for row 0; it must be finite, and at least 0"),
    ],
)
def test_a_prior_that_breaks_the_contract_is_refused(given, message):
    check_prior(predicted(), Mine(), 2, 2)
    with pytest.raises(ValueError, match=message):
        check_prior(given, Mine(), 2, 2)


class Foreteller(Mine):
    use = "prior"

    def prior(self, states, actions):
        return PriorPredictions(np.full(states.shape, np.nan), np.ones(states.shape))


@pytest.mark.parametrize("bounds", [None, ([-1.0, 0.0], [1.0, 2.0])], ids=["other units", "the same units"])
def test_a_wrong_prior_is_refused_before_anything_is_learned(bounds):
    with pytest.raises(ValueError, match=r"Foreteller.prior returned effect .* must be finite"):
        FittedRMax(Walk(), transfer=Foreteller(), bounds=bounds, seed=0).learn(60)


def steady_timbrel():
    return TIMBREL(walk_source(), InterTaskMapping([0, 1], [0, 1]), breadth_decay=1.0)


def test_a_source_must_bring_the_full_weight(monkeypatch):
    model = small(Walk(limit=3), transfer=Mine(), model_breadth=0.03, resolution=5).learn(60)
    monkeypatch.setattr(Mine, "transferred", too_light)
    with pytest.raises(ValueError, match="must reach the threshold of 1,"):
        model.learn(30, reset_num_timesteps=False)


def too_light(self, states, actions, own_weight):
    """Return weights that fail the full threshold only."""
    found = TransferredInstances.empty(len(own_weight), states.shape[1], 1)
    found.length[:] = own_weight < 0.9
    found.weight[:, 0] = 0.95 - own_weight
    return found


class Forgetful(Mine):
    """Prepares itself, and forgets the rest."""

    def bind(self, task, rng):
        self.effects = np.zeros((task.n_actions, task.n_variables))


class Misspelt(Mine):
    """Means a prior."""

    use = "priors"


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (Forgetful, r"Forgetful is bound to no task: a method bind\(task, rng\) of its own must call super\(\)\.bind"),
        (Misspelt, "Misspelt.use must be one of instances, prior, actions, got 'priors'"),
    ],
)
def test_a_method_of_ones_own_that_is_not_what_it_should_be_is_named(method, message):
    with pytest.raises(ValueError, match=message):
        small(transfer=method()).learn(10)


class Silent(Transfer):
    """Transfers nothing, and decides nothing."""

    use = "actions"

    def transferred(self, states, actions, own_weight):
        raise AssertionError("a method that decides actions only is not asked for instances")

    def observe(self, state, action, reward, next_state, terminated):
        self.observed = [*getattr(self, "observed", []), (self.environment, state.copy(), action, reward)]


class Deciding(Silent):
    """Decides on every other action: that of its constructor."""

    def __init__(self, what=1, every=2):
        self.what, self.every = what, every
        self.asked = []

    def action(self, state):
        self.asked.append((self.environment, state.copy()))
        return self.what if len(self.asked) % self.every == 0 else None


class Undecided(Silent):
    """Is asked, and leaves all to the agent."""

    def action(self, state):
        return None


def test_the_agent_does_what_is_decided_and_else_what_it_would():
    agent = make_agent(1, 3, Deciding(2, every=1))
    assert [agent.act(np.array([at])) for at in (0.1, 0.5, 0.9)] == [2, 2, 2]
    assert {make_agent(1, 3, Deciding(2, every=9), rng=seed).act(np.array([0.5])) for seed in range(20)} == {0, 1, 2}


def test_it_is_asked_once_at_each_step_of_learning_with_the_state_that_is_observed_next():
    model = small(transfer=Deciding()).learn(70)
    method = model.policy.transfer
    assert len(method.asked) == len(method.observed) == 70
    for (_, asked), (_, state, *_) in zip(method.asked, method.observed, strict=True):
        np.testing.assert_array_equal(asked, state)
    assert {action for *_, action, _ in method.observed[1::2]} == {1}
    assert {action for *_, action, _ in method.observed[::2]} == {0, 1} and model.agent.model.n_instances == 70
    for deterministic in (True, False):
        model.predict(OBSERVATIONS, deterministic=deterministic)
    model.agent.q_values(np.array([0.5, 0.5]))
    assert len(method.asked) == 70, "it is not asked for predictions"


@pytest.mark.parametrize("method", [Silent, Undecided])
def test_one_that_decides_nothing_leaves_learning_as_it_is_without_transfer(method):
    alone, with_it = small().learn(100), small(transfer=method()).learn(100)
    assert same_parameters(alone, with_it)


def test_each_environment_has_its_number():
    method = small(make_vec_env(Walk, n_envs=3), transfer=Deciding()).learn(60).policy.transfer
    assert [environment for environment, _ in method.asked] == [0, 1, 2] * 20
    assert [environment for environment, *_ in method.observed] == [0, 1, 2] * 20 and Deciding.environment == 0


@pytest.mark.parametrize("what", [-1, 3, 1.0, True, "left", [1]], ids=repr)
def test_whatever_is_no_action_is_refused(what):
    agent = make_agent(1, 3, Deciding(what, every=1))
    with pytest.raises(ValueError, match=r"Deciding\.action must return None or a whole number from 0 to 2, got"):
        agent.act(np.array([0.5]))


def test_a_method_of_instances_must_have_some():
    class Silent(Transfer):
        def observe(self, state, action, reward, next_state, terminated):
            pass

    with pytest.raises(ValueError, match=r'Silent has use="instances", but no method transferred'):
        small(transfer=Silent())

    class Acting(Silent):
        use = "actions"

    assert small(transfer=Acting()).learn(20).agent.model.n_instances == 20


def test_what_is_kept_must_be_taken_back():
    class Keeps(Mine):
        def get_state(self):
            return {"n": np.zeros(1)}

    with pytest.raises(ValueError, match=r"Keeps must have both get_state\(\) and set_state\(state\), or neither"):
        small(transfer=Keeps())


@pytest.mark.parametrize("lowest", [None, np.nan, "-1"])
def test_a_lowest_reward_must_be_a_finite_number(lowest):
    method = Mine()
    method.lowest_reward = lambda: lowest
    with pytest.raises(
        ValueError, match=re.escape(f"what Mine.lowest_reward returns must be a finite number, got {lowest!r}")
    ):
        small(transfer=method)
