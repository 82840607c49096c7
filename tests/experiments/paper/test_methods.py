"""Every method of every domain and setting binds to its target and learns; what is random depends on the seed; targets."""

from collections import Counter
from dataclasses import replace

import pytest

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, MappingSet
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import BEST, DOMAINS, EXPLORE, ICUB, MOUNTAIN_CAR, PAPER, SETTINGS
from sb3_combrel.experiments.paper.jobs import jobs_of
from sb3_combrel.experiments.paper.targets import methods_of, targets_of
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
    ("mountain_car", EXPLORE): OF_CAR,
    ("mountain_car", BEST): WITH_PRIOR | {m.TIMBREL_INTUITIVE},
    ("icub", PAPER): OF_ROBOT,
    ("icub", EXPLORE): OF_ROBOT,
    ("icub", BEST): WITH_PRIOR,
}
FREQUENT = InterTaskMapping(state=(0, 1, None, None), action=(0, 1, 2, 3, 3, 2, 0, 1))


def transfer_of(domain, setting, method, sources, seed=5000):
    given = replace(sources[domain], frequent=FREQUENT)
    return m.transfer_of(method, DOMAINS[domain], DOMAINS[domain].settings[setting], given, seed)


@pytest.mark.parametrize(("domain", "setting"), EXISTING)
def test_the_methods_that_exist(domain, setting):
    found = m.methods_in(DOMAINS[domain], DOMAINS[domain].settings[setting])
    assert set(found) == EXISTING[domain, setting]
    assert found == [name for name in m.METHODS if name in found]


@pytest.mark.parametrize(("domain", "setting"), EXISTING)
def test_every_method_binds_to_its_target_and_learns(domain, setting, sources):
    chosen = DOMAINS[domain].settings[setting]
    use = "prior" if setting == BEST else "instances"
    # With many instances, of many mappings, and on a fine grid a step takes long.
    few = {name: replace(each, own=each.own.subset(10), unrelated=each.unrelated.subset(10)) for name, each in sources.items()}
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
            assert transfer.source is (few[domain].unrelated if method == m.UNRELATED else few[domain].own)
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
    assert sources["mountain_car"].unrelated.origin == sources["icub"].own.origin
    assert sources["icub"].unrelated.origin == sources["mountain_car"].own.origin


@pytest.mark.parametrize("setting", [PAPER, EXPLORE])
@pytest.mark.parametrize("domain", DOMAINS)
def test_one_random_mapping_is_drawn_by_the_seed(domain, setting, sources):
    drawn, again = ([transfer_of(domain, setting, m.ONE_RANDOM, sources, seed).mapping for seed in range(20)] for _ in "ab")
    assert drawn == again
    assert len(set(drawn)) > 10
    if setting == PAPER:
        # The other sets have too many to go through them all.
        assert set(drawn) <= set({"mountain_car": MappingSet.paper_mountain_car, "icub": MappingSet.paper_icub}[domain]())


def test_one_random_mapping_with_a_prior_is_drawn_by_the_seed(sources):
    def drawn(seed):
        transfer = transfer_of("mountain_car", BEST, m.ONE_RANDOM, sources)
        with chosen_on_purpose():
            return FittedRMax(make_env(MOUNTAIN_CAR.target_id), transfer=transfer, seed=seed).agent.transfer.describe_prior()

    assert drawn(0) == drawn(0)
    assert len({drawn(seed) for seed in range(4)}) > 1


class TestTargets:
    def test_the_jobs_are_those_of_each_seed_and_method(self, sources):
        (target,) = targets_of("fig2", PAPER)
        jobs = jobs_of(MOUNTAIN_CAR, PAPER, methods_of([target], MOUNTAIN_CAR, PAPER), sources["mountain_car"], 3, 7)
        assert Counter(job.method for job in jobs) == Counter(dict.fromkeys(target.methods["mountain_car"], 3) | {m.ORACLE: 0})
        assert {(job.seed, job.n_episodes) for job in jobs} == {(seed, 7) for seed in (5000, 5001, 5002)}
        assert len({job.name for job in jobs}) == len(jobs)
        assert {job.method for job in jobs if job.records_selections} == {m.COMBREL_PLAIN}

    @pytest.mark.parametrize("setting", SETTINGS)
    def test_all_of_a_setting_need_methods_that_exist_there(self, setting):
        targets = targets_of("all", setting)
        assert {"fig2", "fig5", "fig6", "table5", "table6"} <= {target.name for target in targets}
        for domain in DOMAINS.values():
            needed = methods_of(targets, domain, setting)
            assert set(needed) == EXISTING[domain.name, setting]
            # Its mapping is that of runs of COMBREL.
            assert m.COMBREL_PLAIN in needed
