"""Every method of every domain and setting binds to its target and learns; what is random depends on the seed; targets."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers.pages import ROOT
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, MappingSet
from sb3_combrel.experiments.numbers import cells_of
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import BEST, DIAGNOSED, DOMAINS, ICUB, MOUNTAIN_CAR, PAPER, SETTINGS
from sb3_combrel.experiments.paper.jobs import (
    BREADTHS,
    DIAGNOSED_EPISODES,
    DIAGNOSED_METHODS,
    diagnosis_jobs,
    jobs_of,
    uses_of,
)
from sb3_combrel.experiments.paper.targets import methods_of, targets_of
from sb3_combrel.experiments.tasks import icub_arm, mountain_car
from sb3_combrel.experiments.tasks.mountain_car import factored_mapping, intuitive_mapping
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.runs.job import chosen_on_purpose, make_env

# Made by hand: the class, the mapping that TIMBREL is given (where it is text), and whether relevance counts.
CLASSES = {
    m.NO_TRANSFER: (None, None, False),
    m.NO_TRANSFER_BEST: (None, None, False),
    m.TIMBREL_INTUITIVE: (TIMBREL, None, False),
    m.COMBREL_PLAIN: (COMBREL, None, False),
    m.COMBREL_RELEVANCE: (COMBREL, None, True),
    m.TIMBREL_RELEVANCE: (TIMBREL, "pool", True),
    m.COMBREL_WHOLE: (COMBREL, None, False),
    m.TIMBREL_RANDOM: (TIMBREL, "random", False),
    m.ONE_RANDOM: (TIMBREL, None, False),
    m.TIMBREL_FREQUENT: (TIMBREL, None, False),
    m.ORACLE: (TIMBREL, None, False),
    m.UNRELATED: (COMBREL, None, False),
}
OF_ROBOT = set(m.METHODS) - {m.TIMBREL_INTUITIVE, m.COMBREL_RELEVANCE, m.TIMBREL_RELEVANCE, m.COMBREL_WHOLE}
OF_CAR = set(m.METHODS) - {m.TIMBREL_FREQUENT, m.ORACLE}
WITH_PRIOR = {m.NO_TRANSFER, m.COMBREL_PLAIN, m.ONE_RANDOM, m.UNRELATED}
EXISTING = {
    ("mountain_car", PAPER): OF_CAR,
    ("mountain_car", BEST): WITH_PRIOR | {m.TIMBREL_INTUITIVE},
    ("icub", PAPER): OF_ROBOT,
    ("icub", BEST): WITH_PRIOR,
}
FREQUENT = InterTaskMapping(state=(0, 1, None, None), action=(0, 1, 2, 3, 3, 2, 0, 1))


def transfer_of(domain, setting, method, sources, seed=26000):
    given = replace(sources[domain][26000], frequent=FREQUENT)
    return m.transfer_of(method, DOMAINS[domain], DOMAINS[domain].settings[setting], given, seed)


@pytest.mark.parametrize(("domain", "setting"), EXISTING)
def test_the_methods_that_exist(domain, setting):
    found = m.methods_in(DOMAINS[domain], DOMAINS[domain].settings[setting])
    assert set(found) == EXISTING[domain, setting] and found == [name for name in m.METHODS if name in found]


@pytest.mark.parametrize("domain", DOMAINS.values(), ids=DOMAINS)
def test_the_papers_learner_scales_by_the_bounds_of_the_task(domain):
    space = make_env(domain.target_id).observation_space
    np.testing.assert_allclose(domain.settings[PAPER].learner["bounds"], (space.low, space.high), rtol=1e-6)


@pytest.mark.parametrize(("domain", "setting"), EXISTING)
def test_every_method_binds_to_its_target_and_learns(domain, setting, sources):
    chosen = DOMAINS[domain].settings[setting]
    use = "prior" if setting == BEST else "instances"
    # With many instances, of many mappings, and on a fine grid a step takes long.
    few = {
        name: {seed: replace(each, own=each.own.subset(10), unrelated=each.unrelated.subset(10)) for seed, each in own.items()}
        for name, own in sources.items()
    }
    for method in EXISTING[domain, setting]:
        expected_class, mapping, relevance = CLASSES[method]
        transfer = transfer_of(domain, setting, method, few)
        assert type(transfer) is (expected_class or type(None))
        if transfer is not None:
            drawn_once = use == "prior" and method == m.ONE_RANDOM
            assert (transfer.use, transfer.relevance) == (use, relevance)
            if expected_class is TIMBREL:
                text = transfer.mapping if isinstance(transfer.mapping, str) else None
                assert text == ("random" if drawn_once else mapping)
            assert transfer.source is (few[domain][26000].unrelated if method == m.UNRELATED else few[domain][26000].own)
        with make_env(DOMAINS[domain].target_id, max_episode_steps=3) as env, chosen_on_purpose():
            learner = {**m.learner_of(method, DOMAINS[domain], chosen), "resolution": 3}
            model = FittedRMax(env, transfer=transfer, seed=0, **learner).learn(6)
        assert isinstance(model.agent.model, KernelAverage) != (setting == BEST or method == m.NO_TRANSFER_BEST)


def test_the_papers_setting_is_that_of_its_tables(sources):
    car = transfer_of("mountain_car", PAPER, m.COMBREL_PLAIN, sources)
    robot = transfer_of("icub", PAPER, m.COMBREL_PLAIN, sources)
    for transfer, mappings, breadth in ((car, "paper_mountain_car", 0.4), (robot, "paper_icub", 0.1)):
        assert transfer.measured == "first_episode"
        assert (transfer.mappings, transfer.n_neighbors, transfer.breadth) == (mappings, 3, breadth)
        assert (transfer.breadth_decay, transfer.min_compliance, transfer.min_evidence) == (1.0, 0.0, 0.0)
    whole = transfer_of("mountain_car", PAPER, m.COMBREL_WHOLE, sources)
    assert (whole.neighbors, car.neighbors) == ("state_action", "action")


def test_mappings_of_a_person_of_the_oracle_and_from_an_unrelated_source(sources):
    assert transfer_of("mountain_car", PAPER, m.TIMBREL_INTUITIVE, sources).mapping == intuitive_mapping()
    assert transfer_of("mountain_car", BEST, m.TIMBREL_INTUITIVE, sources).mapping == factored_mapping(2)
    assert len(transfer_of("icub", PAPER, m.ORACLE, sources).mapping) == len(ICUB.target_names()[1])
    assert transfer_of("mountain_car", PAPER, m.UNRELATED, sources).mappings == "injective"
    for seed, of_car in sources["mountain_car"].items():
        assert of_car.unrelated.origin == sources["icub"][seed].own.origin
        assert sources["icub"][seed].unrelated.origin == of_car.own.origin


@pytest.mark.parametrize("domain", DOMAINS)
def test_one_random_mapping_is_drawn_by_the_seed(domain, sources):
    drawn, again = ([transfer_of(domain, PAPER, m.ONE_RANDOM, sources, seed).mapping for seed in range(20)] for _ in "ab")
    assert drawn == again and len(set(drawn)) > 10
    assert set(drawn) <= set({"mountain_car": MappingSet.paper_mountain_car, "icub": MappingSet.paper_icub}[domain]())


def test_one_random_mapping_with_a_prior_is_drawn_by_the_seed(sources):
    def drawn(seed):
        transfer = transfer_of("mountain_car", BEST, m.ONE_RANDOM, sources)
        with chosen_on_purpose():
            return FittedRMax(make_env(MOUNTAIN_CAR.target_id), transfer=transfer, seed=seed).agent.transfer.describe_prior()

    assert drawn(0) == drawn(0) and len({drawn(seed) for seed in range(4)}) > 1


class TestTargets:
    def test_the_jobs_are_those_of_each_seed_and_method(self, sources):
        (target,) = targets_of("fig2", PAPER)
        jobs = jobs_of(MOUNTAIN_CAR, PAPER, methods_of([target], MOUNTAIN_CAR, PAPER), sources["mountain_car"], 7)
        assert Counter(job.method for job in jobs) == Counter(dict.fromkeys(target.methods["mountain_car"], 3) | {m.ORACLE: 0})
        assert {(job.seed, job.n_episodes) for job in jobs} == {(seed, 7) for seed in (26000, 26001, 26002)}
        assert len({job.name for job in jobs}) == len(jobs)
        assert {job.method for job in jobs if job.records_selections} == {m.COMBREL_PLAIN}
        of_combrel = {job.seed: job.transfer.source for job in jobs if job.method == m.COMBREL_PLAIN}
        assert all(source is sources["mountain_car"][seed].own for seed, source in of_combrel.items())

    @pytest.mark.parametrize("setting", SETTINGS)
    def test_all_of_a_setting_need_methods_that_exist_there(self, setting):
        targets = targets_of("all", setting)
        assert {"fig2", "fig5", "fig6", "table5", "table6"} <= {target.name for target in targets}
        for domain in DOMAINS.values():
            needed = methods_of(targets, domain, setting)
            assert set(needed) == EXISTING[domain.name, setting]
            # Its mapping is that of runs of COMBREL.
            assert m.COMBREL_PLAIN in needed


# What a run records, compared with a plain replay of the same run; and the jobs of the diagnosis.
N_EPISODES = 3
METHODS = [
    pytest.param(("mountain_car", m.COMBREL_WHOLE), id="whole mappings", marks=pytest.mark.long),
    pytest.param(("icub", m.COMBREL_PLAIN), id="iCub"),
]


def job_of(short, domain, method, sources):
    (job,) = jobs_of(short[domain], PAPER, [method], {5000: sources[domain][26000]}, N_EPISODES)
    # COMBREL chooses from many more mappings on the iCub, and its steps take longer.
    return replace(job, max_episode_steps=60 if domain == "icub" else 250)


class Replay(BaseCallback):
    """Keeps each step's state, asked of the environment and not of the learner, and which counts have grown."""

    def __init__(self, states):
        super().__init__()
        self.rows, self.n_done, self.before, self.states = [], 0, {}, states
        self.used = [set() for _ in range(N_EPISODES)]

    def _on_step(self):
        uses, state = self.model.agent.transfer.uses(), self.states[self.num_timesteps - 1]
        new = [(number, state) for number, n in uses.items() if n > self.before.get(number, 0)]
        self.rows += new
        self.used[self.n_done] |= {number for number, _ in new}
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


@pytest.fixture(scope="module", params=METHODS)
def run(request, short, sources):
    """A job, its result, a model that has learned the same, and what its learning was seen to do."""
    job = job_of(short, *request.param, sources)
    result = job.carry_out()
    env, states = with_states(job.make_env())
    with chosen_on_purpose():
        model = FittedRMax(env, transfer=job.transfer, seed=job.seed, **job.learner)
        callback = Replay(states)
        model.learn(10**6, callback)
    return job, result, model.agent.transfer, callback


def test_selections_are_those_of_the_transfer_method(run):
    job, result, transfer, replay = run
    assert (result.name, result.group, result.method, result.seed) == (job.name, job.group, job.method, job.seed)
    assert len(result.steps) == N_EPISODES and 0.0 < result.more["first_episode_seconds"] <= result.seconds
    uses, selections = result.more["uses"], result.more["selections"]
    counts = np.bincount([int(row[0]) for row in selections], minlength=len(uses))
    assert counts.tolist() == [use[-1] for use in uses] == sorted(counts, reverse=True)
    # The random source of the mountain car reaches little beyond what the target knows by then.
    assert sum(counts) == sum(transfer.uses().values()) > (0 if job.group == "mountain_car" else 5)
    numbers = list(uses_of(transfer))
    assert [numbers[int(row[0])] for row in selections] == [number for number, _ in replay.rows]
    np.testing.assert_allclose([row[1:] for row in selections], [state for _, state in replay.rows], atol=1e-5)


def test_the_mappings_of_each_episode_are_counted(run):
    _, result, transfer, replay = run
    # In "uses" they follow the target action and precede the number of times.
    named = [{tuple(map(str, uses_of(transfer)[number][1:4])) for number in used} for used in replay.used]
    assert result.more["mappings_of_episodes"] == [len(names) for names in named] and any(named)


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
    jobs = diagnosis_jobs(car, PAPER, sources["mountain_car"], 300)
    assert len({job.name for job in jobs}) == len(jobs) == len(BREADTHS) * len(DIAGNOSED_METHODS) * 3
    assert {job.n_episodes for job in jobs} == {DIAGNOSED_EPISODES}
    assert {job.n_episodes for job in diagnosis_jobs(car, PAPER, sources["mountain_car"], 3)} == {3}
    for job in jobs:
        method, breadth = job.method.split(" at ")
        assert method in DIAGNOSED_METHODS
        assert job.learner == {**DIAGNOSED.learner, "model_breadth": float(breadth)}
        assert (job.transfer is None) == (method == DIAGNOSED_METHODS[0]) and not job.records_selections


def test_the_page_has_the_parameters_of_tables_1_and_3():
    text = (ROOT / "docs/results.md").read_text()
    _, rows = cells_of(text[text.index("| parameter | Mountain Car | iCub |") :].partition("\n\n")[0])
    for column, (domain, task) in enumerate([(MOUNTAIN_CAR, mountain_car), (ICUB, icub_arm)], start=1):
        learner, combrel = domain.settings[PAPER].learner, domain.settings[PAPER].combrel
        names = "model_breadth", "min_fraction", "min_weight"
        expected = [*(learner[name] for name in names), task.N_INSTANCES, combrel["n_neighbors"]]
        assert [float(row[column]) for row in rows] == expected
        assert combrel["breadth"] == learner["model_breadth"]
