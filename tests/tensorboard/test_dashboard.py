"""What a run shows in TensorBoard: the event files are read back, and compared with what is worked out here."""

import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.tensorboard.callback import DashboardCallback
from sb3_combrel.tensorboard.history import MOST_COLUMNS, ChoiceHistory
from sb3_combrel.tensorboard.layout import LAYOUT
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.tensorboard.pictures import chosen_source_actions, greedy_actions, state_mapping_shares
from sb3_combrel.tensorboard.plane import numbered, plane_through
from sb3_combrel.tensorboard.readings import action_values, bellman_residual, mean_compliance, spread


class Walk(gym.Env):
    """A walk on a line to its right end; a second variable never changes."""

    state_names = ("place", "height")
    action_names = ("back", "forth")

    def __init__(self, limit=30):
        self.observation_space = spaces.Box(np.float32([-1.0, 0.0]), np.float32([1.0, 2.0]))
        self.action_space = spaces.Discrete(2)
        self.limit = limit

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = self.np_random.uniform(-0.6, 0.0), 0
        return np.array([self.at, 1.0], dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        self.at = float(np.clip(self.at + (0.15 if action == 1 else -0.15), -1.0, 1.0))
        done = self.at > 0.9
        return np.array([self.at, 1.0], dtype=np.float32), -1.0, done, self.steps >= self.limit and not done, {}


@pytest.fixture(scope="module")
def source():
    return SourceInstances.record(None, Walk(), n_instances=150, seed=0)


@pytest.fixture(scope="module")
def transfers(source):
    mapping = InterTaskMapping((0, 1), (0, 1))
    return {
        "none": None,
        "TIMBREL": TIMBREL(source, mapping),
        "random": TIMBREL(source, "random"),
        "pool": TIMBREL(source, "pool"),
        "COMBREL": COMBREL(source),
    }


METHODS = ["none", "TIMBREL", "random", "pool", "COMBREL"]


def walker(log=None, transfer=None, env=None, **kwargs):
    env = Walk() if env is None else env
    return FittedRMax(
        env, transfer=transfer, model_breadth=0.15, resolution=3, seed=0, tensorboard_log=log and str(log), **kwargs
    )


def events(folder):
    found = EventAccumulator(str(folder), size_guidance={"images": 0, "tensors": 0, "scalars": 0})
    return found.Reload()


def scalars(found, tag):
    return {event.step: event.value for event in found.Scalars(tag)}


class Witness(BaseCallback):
    """Works out at every log what the log should say."""

    def __init__(self, of):
        super().__init__()
        self.of = of
        self.seen = {}

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.seen[self.num_timesteps] = self.of(self.model)


# ------------------------------------------------------------------- scalars


@pytest.mark.parametrize("method", METHODS)
def test_every_group_of_scalars_is_there(method, transfers, tmp_path):
    walker(tmp_path, transfers[method]).learn(200)
    tags = set(events(tmp_path / "FittedRMax_1").Tags()["scalars"])
    always = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "model/instances", "model/known", "model/optimistic"}
    always |= {"model/transferred", "planner/backups", "planner/residual", "planner/time_share"}
    assert always <= tags
    of_transfer = {"transfer/instances_used", "transfer/pairs_settled"}
    of_choice = {"transfer/compliance", "transfer/choice_entropy", "transfer/switches", "transfer/distinct_mappings"}
    assert of_transfer <= tags if method != "none" else not any(tag.startswith("transfer/") for tag in tags)
    assert of_choice <= tags if method == "COMBREL" else not of_choice & tags


def test_shares_of_the_grid_are_those_of_its_pairs(transfers, tmp_path):
    def shares(model):
        known, settled = model.policy.model.arrays.known, model.policy.model.arrays.settled
        n = len(known)
        transferred = sum(1 for k, s in zip(known, settled, strict=True) if s and not k)
        return sum(known) / n, transferred / n, sum(~settled) / n, transferred

    witness = Witness(shares)
    walker(tmp_path, transfers["COMBREL"]).learn(300, [witness, DashboardCallback(scalar_share=1.0)])
    found = events(tmp_path / "FittedRMax_1")
    assert len(witness.seen) > 2
    for number, tag in enumerate(["model/known", "model/transferred", "model/optimistic", "transfer/pairs_settled"]):
        assert scalars(found, tag) == pytest.approx({step: seen[number] for step, seen in witness.seen.items()})


def slow_q(policy, point, action):
    pair = action * policy.model.grid.n_points + point
    if not policy.model.arrays.settled[pair]:
        return None
    index, weight = policy.model.arrays.rows.entries(pair)
    return policy.model.arrays.reward[pair] + sum(w * policy.planner.values[i] for i, w in zip(index, weight, strict=True))


def slow_residual(model):
    policy, largest = model.policy, 0.0
    for point in range(policy.model.grid.n_points):
        q = [slow_q(policy, point, action) for action in range(policy.n_actions)]
        if None not in q:
            low, high = policy.planner.bounds
            largest = max(largest, abs(min(max(max(q), low), high) - policy.planner.values[point]))
    return largest


def test_residual_is_the_largest_change_by_a_backup(tmp_path):
    witness = Witness(slow_residual)
    # Without backups to spare, values lag behind: a residual of nought would prove nothing.
    walker(tmp_path, max_backups=0).learn(200, [witness, DashboardCallback(scalar_share=1.0)])
    assert max(witness.seen.values()) > 0.0
    assert scalars(events(tmp_path / "FittedRMax_1"), "planner/residual") == pytest.approx(witness.seen, abs=1e-6)


def slow_compliance(model):
    transfer, means = model.policy.transfer, []
    n_points = len(transfer.target.sample_states)
    for pair, candidate in enumerate(transfer.choices()):
        if candidate < 0:
            continue
        action, point = divmod(pair, n_points)
        n = transfer._seen.n
        mine = np.flatnonzero(transfer._seen.actions[:n] == action)
        apart = ((transfer._seen.states[mine] - transfer.target.sample_states[point]) ** 2).sum(axis=1)
        near = mine[np.argsort(apart, kind="stable")[: transfer.n_neighbors]]
        means.append(transfer._ballots.compliance[near, candidate - transfer._ways.first[action]].mean())
    return np.mean(means)


def test_compliance_is_that_of_the_chosen_mapping_with_the_nearest_transitions(transfers, tmp_path):
    witness = Witness(slow_compliance)
    walker(tmp_path, transfers["COMBREL"]).learn(150, [witness, DashboardCallback(scalar_share=1.0)])
    found = scalars(events(tmp_path / "FittedRMax_1"), "transfer/compliance")
    assert len(found) > 1 and found == pytest.approx(witness.seen, rel=1e-5)


def test_entropy_and_number_of_mappings_are_those_of_the_choices(transfers, tmp_path):
    def entropy(model):
        chosen = [c for c in model.policy.transfer.choices() if c >= 0]
        shares = np.array([chosen.count(c) for c in set(chosen)]) / len(chosen)
        return -sum(shares * np.log(shares)), len(shares)

    witness = Witness(entropy)
    walker(tmp_path, transfers["COMBREL"]).learn(200, [witness, DashboardCallback(scalar_share=1.0)])
    found = events(tmp_path / "FittedRMax_1")
    assert scalars(found, "transfer/choice_entropy") == pytest.approx({s: e for s, (e, _) in witness.seen.items()}, abs=1e-6)
    assert scalars(found, "transfer/distinct_mappings") == {s: n for s, (_, n) in witness.seen.items()}


def test_scalars_stay_within_their_share_of_the_time(tmp_path, monkeypatch):
    from sb3_combrel.tensorboard import readings

    def slowly(policy, most_points=0):
        time.sleep(0.02)
        return 0.0

    monkeypatch.setattr(readings, "bellman_residual", slowly)
    began = time.perf_counter()
    walker(tmp_path).learn(3000, DashboardCallback(picture_freq=None, scalar_share=0.1), log_interval=1)
    took = time.perf_counter() - began
    found = events(tmp_path / "FittedRMax_1")
    assert 1 <= len(found.Scalars("planner/residual")) <= 1 + 0.1 * took / 0.02
    assert (
        len(found.Scalars("planner/residual")) == len(found.Scalars("model/known")) < len(found.Scalars("rollout/ep_rew_mean"))
    )


def test_planning_takes_a_part_of_the_time(tmp_path):
    model = walker(tmp_path).learn(200)
    assert all(0.0 < share < 1.0 for share in scalars(events(tmp_path / "FittedRMax_1"), "planner/time_share").values())
    assert not model.policy.timed


# ------------------------------------------------------- pictures, tables, settings


def test_pictures_come_at_the_asked_steps_and_at_the_end(transfers, tmp_path):
    walker(tmp_path, transfers["COMBREL"]).learn(250, DashboardCallback(picture_freq=100), log_interval=1)
    found = events(tmp_path / "FittedRMax_1")
    for tag in ("value_and_policy/place_height", "source_action/place_height", "state_mappings/chosen"):
        assert [image.step for image in found.Images(tag)] == [100, 200, 250]
    assert [text.step for text in found.Tensors("transfer/most_chosen_mappings/text_summary")] == [100, 200, 250]
    assert all(image.width > 300 and image.encoded_image_string.startswith(b"\x89PNG") for image in found.Images(tag))


@pytest.mark.parametrize("method", METHODS)
def test_pictures_of_every_method(method, transfers, tmp_path):
    walker(tmp_path, transfers[method]).learn(120, DashboardCallback(), log_interval=1)
    found = events(tmp_path / "FittedRMax_1")
    of_choice = ["source_action/place_height", "state_mappings/chosen"] if method in ("TIMBREL", "COMBREL") else []
    assert sorted(found.Tags()["images"]) == sorted(["value_and_policy/place_height", *of_choice])
    assert ("transfer/most_chosen_mappings/text_summary" in found.Tags()["tensors"]) == (method != "none")


def test_pictures_that_nobody_asked_for_stay_within_their_share_of_the_time(transfers, tmp_path, monkeypatch):
    def slowly(self):
        shown.append(time.perf_counter() - began)
        time.sleep(0.05)

    shown = []
    monkeypatch.setattr(DashboardCallback, "_write_pictures", slowly)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.FIRST_PICTURES_SECONDS", 0.01)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.DEFAULT_PICTURE_FREQ", 10)
    began = time.perf_counter()
    walker(tmp_path, transfers["COMBREL"]).learn(3000)
    took = time.perf_counter() - began
    # The first set was expected to take 0.01 seconds, so it came after 0.2 seconds at the earliest.
    assert 1 <= len(shown) <= 2 + 0.05 * took / 0.05 and shown[0] > 0.15


def test_a_short_run_has_no_pictures_unless_they_are_asked_for(tmp_path):
    walker(tmp_path).learn(120)
    found = events(tmp_path / "FittedRMax_1")
    assert not found.Tags()["images"] and "model/known" in found.Tags()["scalars"]


def test_no_pictures_without_a_frequency(tmp_path):
    command = (
        "import sys; from sb3_combrel import FittedRMax; from sb3_combrel.tensorboard.callback import DashboardCallback;"
        "model = FittedRMax('MountainCar-v0', seed=0, tensorboard_log=sys.argv[1]);"
        "model.learn(300, DashboardCallback(picture_freq=None)); print('matplotlib' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", command, str(tmp_path)], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False"]
    assert not events(tmp_path / "FittedRMax_1").Tags()["images"]


def test_without_matplotlib_there_are_no_pictures_but_all_else(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.find_spec", lambda name: None)
    walker(tmp_path).learn(150)
    found = events(tmp_path / "FittedRMax_1")
    assert not found.Tags()["images"] and "model/known" in found.Tags()["scalars"]
    with pytest.raises(ModuleNotFoundError, match="matplotlib"):
        walker(tmp_path).learn(10, DashboardCallback())


def test_the_greedy_action_is_the_best_of_the_model(tmp_path):
    policy = walker().learn(400).policy
    points = np.arange(policy.model.grid.n_points)
    q = action_values(policy, points)
    greedy = greedy_actions(policy, points)
    for point in points:
        slow = [slow_q(policy, point, action) for action in range(2)]
        assert q[:, point] == pytest.approx([np.nan if value is None else value for value in slow], nan_ok=True)
        assert greedy[point] == (-1 if None in slow else int(np.argmax(slow)))
    assert {-1, 0, 1} >= set(greedy) and (greedy >= 0).any()


def test_the_plane_goes_through_the_asked_state():
    policy = walker().policy
    grid, states = policy.model.grid, policy.scaling.to_raw(policy.model.grid.points())
    plane = plane_through(grid, policy.scaling, policy.state_names, (0, 1))
    assert plane.points.shape == (9, 9) and plane.names == ("place", "height") and plane.held == ""
    assert states[plane.points[0, 0]] == pytest.approx([-1.0, 0.0])
    assert states[plane.points[0, -1]] == pytest.approx([1.0, 0.0])
    assert states[plane.points[-1, 0]] == pytest.approx([-1.0, 2.0])
    assert plane.extent == pytest.approx((-1.125, 1.125, -0.125, 2.125))


def test_other_variables_are_held_at_the_nearest_grid_points():
    low, high = np.float32([0, 0, -1]), np.float32([1, 10, 1])
    policy = FittedRMax(Box3(low, high), model_breadth=0.3, resolution=2).policy
    plane = plane_through(policy.model.grid, policy.scaling, ("a", "b", "c"), (2, 0), at=[0.5, 7.0, 0.3])
    states = policy.scaling.to_raw(policy.model.grid.points())[plane.points]
    assert np.all(states[..., 1] == 7.5) and plane.held == "b = 7.5"
    assert np.all(np.diff(states[..., 2], axis=1) > 0) and np.all(np.diff(states[..., 0], axis=0) > 0)


class Box3(gym.Env):
    """Three variables, one action, nothing happens."""

    def __init__(self, low, high):
        self.observation_space, self.action_space = spaces.Box(low, high), spaces.Discrete(1)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.low, {}

    def step(self, action):
        return self.observation_space.low, 0.0, False, False, {}


def test_a_task_with_one_variable_has_pictures_too(tmp_path):
    FittedRMax(Box3(np.float32([0]), np.float32([1])), seed=0, tensorboard_log=str(tmp_path)).learn(50, DashboardCallback())
    assert events(tmp_path / "FittedRMax_1").Tags()["images"] == ["value_and_policy/s0"]


def test_source_actions_are_those_of_the_chosen_mappings(transfers):
    policy = walker(transfer=transfers["COMBREL"]).learn(200).policy
    points = np.arange(policy.model.grid.n_points)
    names, numbers = chosen_source_actions(policy.transfer, points, 2)
    assert names == ["back", "forth"]
    for action in range(2):
        for point in points:
            candidate = policy.transfer.choices()[action * len(points) + point]
            words = policy.transfer.describe(candidate) if candidate >= 0 else ""
            expected = -1 if candidate < 0 else names.index(words.split("<-")[1].split(" ")[0])
            assert numbers[action, point] == expected


def test_shares_of_state_mappings_add_up(transfers):
    transfer = walker(transfer=transfers["COMBREL"]).learn(200).policy.transfer
    history = ChoiceHistory()
    history.note(0, np.full(9, -1))
    history.note(100, transfer.choices())
    names, shares = state_mapping_shares(history, transfer)
    assert shares[:, 0].sum() == 0.0 and shares[:, 1].sum() == pytest.approx(1.0)
    assert len(set(names)) == len(names) == len(shares)
    chosen = [transfer.way(c).state_mapping for c in transfer.choices() if c >= 0]
    assert shares[:, 1] == pytest.approx([chosen.count(name) / len(chosen) for name in names])


def test_history_stays_small_and_spread_over_the_run():
    history = ChoiceHistory()
    for step in range(5 * MOST_COLUMNS):
        history.note(step, np.array([0]))
    assert len(history.steps) < MOST_COLUMNS
    assert history.steps[0] == 0 and history.steps[-1] > 4.9 * MOST_COLUMNS
    assert len(set(np.diff(history.steps))) == 1


def test_the_table_of_mappings_counts_uses(transfers):
    transfer = walker(transfer=transfers["COMBREL"]).learn(200).policy.transfer
    lines = [
        line.split("|")[1:-1] for line in mapping_table(transfer, ("back", "forth")).splitlines() if line.startswith("| ")
    ]
    header, rows = [cell.strip() for cell in lines[0]], {line[0].strip(): line[1:] for line in lines[2:]}
    assert header == ["source action and state mapping", "back", "forth", "All"]
    counts = dict(transfer.mapping_counts())
    total = sum(counts.values())
    for name, cells in rows.items():
        if " with " not in name:
            continue
        source_action, variables = name.split(" with ")
        uses = [counts.get(f"{target}<-{source_action} with {variables}", 0) for target in header[1:3]]
        assert float(cells[-1]) == pytest.approx(100 * sum(uses) / total, abs=0.051)
    assert [float(cell) for cell in rows["Total"]] == [100.0, 100.0, 100.0]


def test_the_table_says_so_where_nothing_was_transferred(transfers):
    assert "No decision" in mapping_table(walker(transfer=transfers["COMBREL"]).policy.transfer, ("back", "forth"))


def test_settings_are_in_the_hparams_tab(transfers, tmp_path):
    walker(tmp_path, transfers["COMBREL"], max_value=1.5).learn(150)
    found = events(tmp_path / "FittedRMax_1")
    content = found.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    settings = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info.hparams
    assert settings["algorithm"].string_value == "FittedRMax + COMBREL"
    assert settings["max_value"].number_value == 1.5
    assert settings["model_breadth"].number_value == 0.15
    assert settings["transfer.n_neighbors"].number_value == 3
    assert settings["transfer.mappings"].string_value == "injective"


def test_the_page_of_custom_scalars_shows_tags_that_exist(transfers, tmp_path):
    walker(tmp_path, transfers["COMBREL"]).learn(200)
    found = events(tmp_path / "FittedRMax_1")
    written = layout_pb2.Layout.FromString(found.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0])
    assert [category.title for category in written.category] == list(LAYOUT)
    shown = {tag.strip("^$") for category in written.category for chart in category.chart for tag in chart.multiline.tag}
    assert shown <= set(found.Tags()["scalars"])


# --------------------------------------------------------- when it is there at all


@pytest.mark.parametrize("method", METHODS)
def test_a_log_changes_nothing_of_what_is_learned(method, transfers, tmp_path):
    plain = walker(transfer=transfers[method]).learn(300)
    logged = walker(tmp_path, transfers[method]).learn(300, DashboardCallback(picture_freq=20), log_interval=1)
    one, other = plain.get_parameters()["policy"], logged.get_parameters()["policy"]
    assert one.keys() == other.keys() and all(th.equal(one[k], other[k]) for k in one)


def test_without_a_log_nothing_is_worked_out(transfers, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("this was for a log that nobody writes")

    monkeypatch.setattr("sb3_combrel.fitted_rmax.policies.FittedRMaxPolicy.statistics", refuse)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.DashboardCallback._on_training_start", refuse)
    monkeypatch.setattr("sb3_combrel.transfer.combrel.COMBREL.choices", refuse)
    model = walker(transfer=transfers["COMBREL"]).learn(200)
    assert model._episode_num > 4 and model.policy.planning_seconds == 0.0
    monkeypatch.undo()
    dashboard = DashboardCallback(picture_freq=10)
    assert walker(transfer=transfers["COMBREL"]).learn(50, dashboard).policy.planning_seconds == 0.0


def test_no_part_of_it_is_imported_without_a_log():
    command = (
        "import sys; from sb3_combrel import FittedRMax; FittedRMax('MountainCar-v0', seed=0).learn(300);"
        "print([m for m in sys.modules if m.startswith(('matplotlib', 'sb3_combrel.tensorboard.pictures'))])"
    )
    result = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_a_logger_of_the_users_own_counts_as_a_log(tmp_path):
    model = walker()
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(150)
    assert "planner/residual" in events(tmp_path).Tags()["scalars"]


@pytest.mark.parametrize("given", ["function", "list", "callback", "nested"])
def test_it_stands_beside_other_callbacks(given, tmp_path):
    calls = []

    def function(locals_, globals_):
        calls.append(1)
        return True

    witness = Witness(lambda model: calls.append(1))
    callback = {
        "function": function,
        "list": [witness],
        "callback": witness,
        "nested": CallbackList([EveryNTimesteps(10, Witness(len)), witness]),
    }[given]
    walker(tmp_path).learn(150, callback)
    assert calls and "planner/residual" in events(tmp_path / "FittedRMax_1").Tags()["scalars"]


@pytest.mark.parametrize("wrap", [list, CallbackList])
def test_one_that_is_given_is_the_only_one(wrap, tmp_path):
    given = DashboardCallback(picture_freq=50, variables=[("height", "place")])
    walker(tmp_path).learn(100, wrap([given]))
    found = events(tmp_path / "FittedRMax_1")
    assert found.Tags()["images"] == ["value_and_policy/height_place"]
    assert [image.step for image in found.Images("value_and_policy/height_place")] == [50, 100]


def test_a_model_is_saved_without_it(transfers, tmp_path):
    model = walker(tmp_path / "log", transfers["COMBREL"]).learn(150)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert "ashboard" not in str(model.__dict__)
    loaded.learn(50, DashboardCallback(), reset_num_timesteps=False)
    assert events(tmp_path / "log" / "FittedRMax_1").Images("value_and_policy/place_height")[-1].step == 200


def test_learning_goes_on_in_the_same_log_after_an_interrupt(transfers, tmp_path):
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 130:
                raise KeyboardInterrupt
            return True

    model = walker(tmp_path, transfers["COMBREL"])
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000, [Interrupt(), DashboardCallback(picture_freq=100)])
    assert not model.policy.timed
    model.save(tmp_path / "model")
    model.learn(100, DashboardCallback(picture_freq=100), reset_num_timesteps=False)
    found = events(tmp_path / "FittedRMax_1")
    assert [image.step for image in found.Images("value_and_policy/place_height")] == [100, 130, 200, 230]


def test_environments_in_other_processes(transfers, tmp_path):
    env = make_vec_env(Walk, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    walker(tmp_path, transfers["COMBREL"], env).learn(200, DashboardCallback(picture_freq=75))
    env.close()
    found = events(tmp_path / "FittedRMax_1")
    assert [image.step for image in found.Images("value_and_policy/place_height")] == [76, 150, 200]
    assert "transfer/compliance" in found.Tags()["scalars"]


def test_without_logs_of_the_algorithm_there_are_pictures_all_the_same(tmp_path):
    walker(tmp_path).learn(100, DashboardCallback(), log_interval=None)
    found = events(tmp_path / "FittedRMax_1")
    assert not found.Tags()["scalars"] and found.Tags()["images"]


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (dict(variables=["place"]), "pairs of state variables"),
        (dict(variables=[("place", "place")]), "two different"),
        (dict(variables=[("place", "speed")]), "place, height"),
        (dict(variables=[(0, 2)]), "below 2"),
        (dict(at=[0.0]), "at must hold 2 numbers"),
    ],
)
def test_what_does_not_fit_the_task_is_refused(wrong, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        walker(tmp_path).learn(10, DashboardCallback(**wrong))


@pytest.mark.parametrize("name", ["scalar_share", "picture_share"])
@pytest.mark.parametrize("share", [0, -0.1, 1.5])
def test_a_share_is_between_nought_and_one(name, share):
    with pytest.raises(ValueError, match=name):
        DashboardCallback(**{name: share})


@pytest.mark.parametrize("freq", [0, -5, 1.5])
def test_a_frequency_is_a_number_of_steps(freq):
    with pytest.raises(ValueError, match="picture_freq"):
        DashboardCallback(picture_freq=freq)


def test_the_first_two_variables_are_drawn_by_default():
    assert numbered(None, ("a", "b", "c")) == [(0, 1)] and numbered(None, ("a",)) == [(0, 0)]


def test_samples_are_spread_and_complete_where_there_is_room():
    assert spread(5, 10).tolist() == [0, 1, 2, 3, 4]
    few = spread(1000, 7)
    assert len(set(few)) == 7 and few.max() > 800


def test_nothing_to_measure_gives_nothing(transfers):
    policy = walker(transfer=transfers["COMBREL"]).policy
    assert bellman_residual(policy) == 0.0 and mean_compliance(policy.transfer) is None
    assert mean_compliance(walker(transfer=transfers["TIMBREL"]).policy.transfer) is None
