"""What a run records, compared with a plain replay of the same run; and its result as bytes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.paper_results import made_up
from sb3_combrel.experiments.result_files import RESULTS
from sb3_combrel.experiments.runs import coarse_on_purpose, make_task
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import FittedRMax
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import DOMAINS, PAPER
from sb3_combrel.experiments.paper.plan import jobs_of
from sb3_combrel.experiments.paper.recording import selections_at_sample, uses_of
from sb3_combrel.experiments.paper.runs import Job, Result, ResultFiles, carry_out

CAP = 300
METHODS = [("mountain_car", m.COMBREL_PLAIN), ("mountain_car", m.COMBREL_WHOLE), ("icub", m.COMBREL_PLAIN)]


def job_of(domain, method, sources, n_episodes=4, max_episode_steps=CAP):
    (job,) = jobs_of(DOMAINS[domain], PAPER, [method], sources[domain], 1, n_episodes)
    return replace(job, max_episode_steps=max_episode_steps)


@pytest.fixture(scope="module", params=METHODS, ids=[f"{domain} {method}" for domain, method in METHODS])
def job_and_result(request, sources):
    job = job_of(*request.param, sources)
    return job, carry_out(job)


class Replay(BaseCallback):
    """Keeps each step's state, asked of the environment and not of the learner, and which counts have grown."""

    def __init__(self, env):
        super().__init__()
        self.rows, self.dones, self.before = [], 0, {}
        self.states = env.states

    def _on_step(self):
        uses = self.model.agent.transfer.uses()
        state = self.states[self.num_timesteps - 1]
        self.rows += [(number, state) for number, n in uses.items() if n > self.before.get(number, 0)]
        self.before = dict(uses)
        self.dones += int(self.locals["dones"][0])
        return self.dones < 4


def states_in_which_steps_were_made(env):
    """Give the environment a list of them, in the order of its steps."""
    env.states, last = [], []
    reset, step = env.reset, env.step

    def recording_reset(**kwargs):
        state, info = reset(**kwargs)
        last[:] = [state.copy()]
        return state, info

    def recording_step(action):
        env.states.append(last[0])
        outcome = step(action)
        last[:] = [outcome[0].copy()]
        return outcome

    env.reset, env.step = recording_reset, recording_step
    return env


@pytest.fixture(scope="module")
def replay(job_and_result):
    job, _ = job_and_result
    env = states_in_which_steps_were_made(make_task(job.env_id, max_episode_steps=job.max_episode_steps))
    with coarse_on_purpose():
        model = FittedRMax(env, transfer=job.transfer, seed=job.seed, **job.learner)
        callback = Replay(env)
        model.learn(10**6, callback)
    env.close()
    return model, callback


@pytest.mark.integration
def test_the_episodes_are_those_of_the_job(job_and_result):
    job, result = job_and_result
    assert (result.name, result.domain, result.method, result.seed) == (job.name, job.domain, job.method, job.seed)
    assert len(result.steps) == len(result.returns) == len(result.terminated) == 4
    for steps, terminated in zip(result.steps, result.terminated, strict=True):
        assert terminated == (steps < CAP) or steps == CAP
    assert 0.0 < result.seconds[1] <= result.seconds[0]


@pytest.mark.integration
def test_selections_counted_are_the_uses_of_the_transfer_method(job_and_result, replay):
    _, result = job_and_result
    model, _ = replay
    counts = np.bincount([int(row[0]) for row in result.selections], minlength=len(result.uses))
    assert counts.tolist() == [use[-1] for use in result.uses]
    assert sum(counts) == sum(model.agent.transfer.uses().values()) > 5
    assert [use[-1] for use in result.uses] == sorted((use[-1] for use in result.uses), reverse=True)


@pytest.mark.integration
def test_names_are_those_of_the_candidates(job_and_result, replay):
    job, result = job_and_result
    transfer = replay[0].agent.transfer
    by_name = {}
    for target_action, source_action, state_mapping, action_mapping, n in result.uses:
        assert bool(action_mapping) == (job.method == m.COMBREL_WHOLE)
        name = f"{target_action}<-{source_action} with {state_mapping}"
        by_name[name] = by_name.get(name, 0) + n
        if action_mapping:
            place = transfer.task.action_names.index(target_action)
            assert action_mapping.split(", ")[place] == source_action
    expected = {}
    for name, n in transfer.mapping_counts():
        short = name if job.method != m.COMBREL_WHOLE else next(key for key in by_name if name.startswith(key) or key in name)
        expected[short] = expected.get(short, 0) + n
    assert by_name == expected


@pytest.mark.integration
def test_states_recorded_are_those_in_which_the_steps_were_made(job_and_result, replay):
    _, result = job_and_result
    model, callback = replay
    numbers = [number for number, _ in uses_of(model.agent.transfer)]
    assert [numbers[int(row[0])] for row in result.selections] == [number for number, _ in callback.rows]
    np.testing.assert_allclose([row[1:] for row in result.selections], [state for _, state in callback.rows], atol=1e-5)


@pytest.mark.integration
def test_the_selection_at_the_sample_is_that_of_the_transfer_method(job_and_result, replay):
    _, result = job_and_result
    transfer = replay[0].agent.transfer
    names = transfer.task.action_names
    assert tuple(result.at_sample) == names
    points = transfer.task.sample_states
    rng = np.random.default_rng(0)
    for action, point in zip(rng.integers(len(names), size=40), rng.integers(len(points), size=40), strict=True):
        # One after the other; for the result all were asked for at once.
        [number] = transfer.selected(points[point][None], np.array([action]))
        expected = "" if number < 0 else transfer.candidate(number).source_action
        assert result.at_sample[names[action]][point] == expected


@pytest.mark.integration
def test_without_transfer_nothing_is_recorded(sources):
    result = carry_out(job_of("mountain_car", m.NO_TRANSFER, sources, 1))
    assert (result.uses, result.selections, result.at_sample) == ([], [], {})
    assert uses_of(None) == [] and selections_at_sample(None) == {}


@pytest.mark.integration
def test_the_same_run_is_the_same_to_the_byte(job_and_result):
    job, result = job_and_result
    assert carry_out(job).text() == result.text()
    assert carry_out(replace(job, seed=job.seed + 1)).text() != result.text()


class TestFiles:
    job = Job("mountain_car", m.COMBREL_PLAIN, 5000, "combrel/MountainCar4D-v0", 2, 100)

    def result(self):
        uses, selections = [["East", "Right", "x<-x", "", 2]], [[0, 0.12345, 1e-05], [0, -1.0, 2.0]]
        result = made_up("mountain_car", m.COMBREL_PLAIN, 5000, [70, 80], uses=uses, selections=selections, seconds=(2.5, 0.5))
        return replace(result, name=self.job.name, at_sample={"East": ["", "Right"]})

    def test_round_trip(self, tmp_path):
        job, result, files = self.job, self.result(), ResultFiles(tmp_path)
        assert files.read(job.name) is None
        assert not files.is_complete(job)
        files.write(result)
        again = files.read(job.name)
        assert again == result
        assert files.is_complete(job)
        assert not files.is_complete(replace(job, n_episodes=3))
        assert not files.is_complete(replace(job, n_episodes=1))
        assert files.read_all([job, replace(job, seed=1)]) == [again]
        assert files.read_domain(job.domain) == [again]
        assert files.read_domain("other") == []
        assert not list(tmp_path.rglob("*.part"))

    def test_every_beginning_of_a_file_counts_as_none(self, tmp_path):
        files = ResultFiles(tmp_path)
        files.write(self.result())
        path = tmp_path / RESULTS / f"{self.job.name}.json"
        whole = path.read_text()
        for length in range(len(whole.rstrip())):
            path.write_text(whole[:length])
            assert files.read(self.job.name) is None

    @pytest.mark.parametrize(
        "content",
        [b"", b"\x00" * 500, b"\xff\xfe\xfa", b"null", b"3", b"[]", b'"text"', b"{}", b'{"name": "a"}', b'{"other": 1}'],
    )
    @pytest.mark.parametrize("folder", [RESULTS, "times"])
    def test_other_contents_count_as_none(self, content, folder, tmp_path):
        files = ResultFiles(tmp_path)
        files.write(Result("name", "d", "m", 0, [1], [-1.0], [True]))
        assert files.read("name") is not None
        (tmp_path / folder / "name.json").write_bytes(content)
        assert files.read("name") is None

    @pytest.mark.parametrize("content", [[], [1.0], [1.0, 2.0, 3.0], "ab", {"a": 1, "b": 2}, [1.0, "b"], [1.0, None]])
    def test_times_that_are_not_two_numbers_count_as_none(self, content, tmp_path):
        files = ResultFiles(tmp_path)
        files.write(Result("name", "d", "m", 0, [1], [-1.0], [True]))
        (tmp_path / "times" / "name.json").write_text(json.dumps(content))
        assert files.read("name") is None
