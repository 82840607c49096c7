"""What a run records, compared with a plain replay of the same run; and the jobs of the diagnosis."""

from dataclasses import replace

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import FittedRMax
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import EXPLORE, PAPER
from sb3_combrel.experiments.paper.jobs import BREADTHS, DIAGNOSED, DIAGNOSED_EPISODES, diagnosis_jobs, jobs_of, uses_of
from sb3_combrel.runs.job import chosen_on_purpose

N_EPISODES = 3
METHODS = [("mountain_car", m.COMBREL_WHOLE), ("icub", m.COMBREL_PLAIN)]


def job_of(short, domain, method, sources):
    (job,) = jobs_of(short[domain], PAPER, [method], sources[domain], 1, N_EPISODES)
    # COMBREL chooses from many more mappings on the iCub, and its steps take longer.
    return replace(job, max_episode_steps=60 if domain == "icub" else 250)


class Replay(BaseCallback):
    """Keeps each step's state, asked of the environment and not of the learner, and which counts have grown."""

    def __init__(self, states):
        super().__init__()
        self.rows, self.n_done, self.before, self.states = [], 0, {}, states

    def _on_step(self):
        uses = self.model.agent.transfer.uses()
        state = self.states[self.num_timesteps - 1]
        self.rows += [(number, state) for number, n in uses.items() if n > self.before.get(number, 0)]
        self.before = dict(uses)
        self.n_done += int(self.locals["dones"][0])
        return self.n_done < N_EPISODES


def with_states(env):
    """The environment, and a list that gets the states in which its steps are made."""
    states, last = [], []
    reset, step = env.reset, env.step

    def recording_reset(**kwargs):
        outcome = reset(**kwargs)
        last[:] = [outcome[0].copy()]
        return outcome

    def recording_step(action):
        states.append(last[0])
        outcome = step(action)
        last[:] = [outcome[0].copy()]
        return outcome

    env.reset, env.step = recording_reset, recording_step
    return env, states


@pytest.fixture(scope="module", params=METHODS, ids=[f"{domain} {method}" for domain, method in METHODS])
def run(request, short, sources):
    """A job, its result, a model that has learned the same, and what its learning was seen to do."""
    job = job_of(short, *request.param, sources)
    result = job.carry_out()
    env, states = with_states(job.make_env())
    with chosen_on_purpose():
        model = FittedRMax(env, transfer=job.transfer, seed=job.seed, **job.learner)
        callback = Replay(states)
        model.learn(10**6, callback)
    return job, result, model.agent.transfer, callback.rows


def test_selections_are_those_of_the_transfer_method(run):
    job, result, transfer, rows = run
    assert (result.name, result.group, result.method, result.seed) == (job.name, job.group, job.method, job.seed)
    assert len(result.steps) == N_EPISODES and 0.0 < result.more["first_episode_seconds"] <= result.seconds
    uses, selections = result.more["uses"], result.more["selections"]
    counts = np.bincount([int(row[0]) for row in selections], minlength=len(uses))
    assert counts.tolist() == [use[-1] for use in uses] == sorted(counts, reverse=True)
    assert sum(counts) == sum(transfer.uses().values()) > 5
    numbers = list(uses_of(transfer))
    assert [numbers[int(row[0])] for row in selections] == [number for number, _ in rows]
    np.testing.assert_allclose([row[1:] for row in selections], [state for _, state in rows], atol=1e-5)


def test_names_are_those_of_the_candidates(run):
    job, result, transfer, _ = run
    by_name = {}
    for target_action, source_action, state_mapping, action_mapping, n in result.more["uses"]:
        assert bool(action_mapping) == (job.method == m.COMBREL_WHOLE)
        name = f"{target_action}<-{source_action} with {state_mapping}"
        by_name[name] = by_name.get(name, 0) + n
        if action_mapping:
            place = transfer.task.action_names.index(target_action)
            assert action_mapping.split(", ")[place] == source_action
    expected = {}
    for name, n in transfer.mapping_counts():
        short = name if job.method != m.COMBREL_WHOLE else next(key for key in by_name if key in name)
        expected[short] = expected.get(short, 0) + n
    assert by_name == expected


def test_the_selection_at_the_sample_is_that_of_the_transfer_method(run):
    _, result, transfer, _ = run
    names, points = transfer.task.action_names, transfer.task.sample_states
    assert tuple(result.more["at_sample"]) == names
    rng = np.random.default_rng(0)
    for action, point in zip(rng.integers(len(names), size=40), rng.integers(len(points), size=40), strict=True):
        # One after the other; for the result all were asked for at once.
        [number] = transfer.selected(points[point][None], np.array([action]))
        expected = "" if number < 0 else transfer.candidate(number).source_action
        assert result.more["at_sample"][names[action]][point] == expected


def test_without_transfer_nothing_is_recorded_and_the_same_run_has_the_same_result(short, sources):
    job = replace(job_of(short, "mountain_car", m.NO_TRANSFER, sources), n_episodes=1)
    result, again = job.carry_out(), job.carry_out()
    assert result.more["uses"] == [] and not {"selections", "at_sample"} & set(result.more)
    assert (result.steps, result.returns, result.n_steps) == (again.steps, again.returns, again.n_steps)


def test_the_jobs_of_the_diagnosis_differ_in_breadth_alone(short, sources):
    car = short["mountain_car"]
    jobs = diagnosis_jobs(car, EXPLORE, sources["mountain_car"], 2, 300)
    assert len({job.name for job in jobs}) == len(jobs) == len(BREADTHS) * len(DIAGNOSED) * 2
    assert {job.n_episodes for job in jobs} == {DIAGNOSED_EPISODES}
    assert {job.n_episodes for job in diagnosis_jobs(car, EXPLORE, sources["mountain_car"], 1, 3)} == {3}
    for job in jobs:
        method, breadth = job.method.split(" at ")
        assert method in DIAGNOSED
        assert job.learner == {**car.settings[EXPLORE].learner, "model_breadth": float(breadth)}
        assert (job.transfer is None) == (method == DIAGNOSED[0])
        assert not job.records_selections
