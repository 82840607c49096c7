"""Every method of every domain and setting binds to its target and learns; what is random depends on the seed."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers.paper_results import made_up, quiet
from sb3_combrel.experiments.runs import coarse_on_purpose, make_task

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, MappingSet
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import BEST, DOMAINS, EXPLORE, ICUB, MOUNTAIN_CAR, PAPER, SETTINGS
from sb3_combrel.experiments.paper.methods import METHODS, methods_in, target_names
from sb3_combrel.experiments.paper.plan import frequent_mapping, jobs_of, methods_of, targets_of
from sb3_combrel.experiments.paper.sources import prepare_sources
from sb3_combrel.experiments.tasks.mountain_car import factored_mapping, intuitive_mapping
from sb3_combrel.models.kernel_average import KernelAverage

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
OF_CAR = {
    *(m.NO_TRANSFER, m.TIMBREL_INTUITIVE, m.COMBREL_PLAIN, m.COMBREL_RELEVANCE, m.TIMBREL_RELEVANCE, m.COMBREL_WHOLE),
    *(m.TIMBREL_RANDOM, m.ONE_RANDOM, m.UNRELATED, m.NO_TRANSFER_BEST),
}
OF_ROBOT = {
    *(m.NO_TRANSFER, m.COMBREL_PLAIN, m.TIMBREL_RANDOM, m.ONE_RANDOM, m.TIMBREL_FREQUENT, m.ORACLE, m.UNRELATED),
    m.NO_TRANSFER_BEST,
}
WITH_PRIOR = {m.NO_TRANSFER, m.COMBREL_PLAIN, m.ONE_RANDOM, m.UNRELATED}
EXISTING = {
    ("mountain_car", PAPER): OF_CAR,
    ("mountain_car", EXPLORE): OF_CAR,
    ("mountain_car", BEST): WITH_PRIOR | {m.TIMBREL_INTUITIVE},
    ("icub", PAPER): OF_ROBOT,
    ("icub", EXPLORE): OF_ROBOT,
    ("icub", BEST): WITH_PRIOR,
}
ALL = [(domain, setting, method) for (domain, setting), methods in EXISTING.items() for method in sorted(methods)]
FREQUENT = InterTaskMapping(state=(0, 1, None, None), action=(0, 1, 2, 3, 3, 2, 0, 1))


def transfer_of(domain, setting, method, sources, seed=5000):
    domain = DOMAINS[domain]
    given = replace(sources[domain.name], frequent=FREQUENT)
    return METHODS[method].transfer(domain, domain.settings[setting], given, seed)


@pytest.mark.parametrize(("domain", "setting"), EXISTING)
def test_the_methods_that_exist(domain, setting):
    found = [method.name for method in methods_in(DOMAINS[domain], DOMAINS[domain].settings[setting])]
    assert set(found) == EXISTING[domain, setting]
    assert found == [name for name in METHODS if name in found]


@pytest.fixture(scope="module")
def few_instances(sources):
    """A tenth of what the methods transfer: with 14,580 candidates a step takes 0.1 s at first with all of it."""

    def few(given):
        return given and given.subset(len(given) // 10, seed=0)

    return {
        name: replace(given, own=few(given.own), unrelated=few(given.unrelated), target=few(given.target))
        for name, given in sources.items()
    }


@pytest.mark.integration
@pytest.mark.parametrize(("domain", "setting", "method"), ALL)
def test_every_method_binds_to_its_target_and_learns(domain, setting, method, few_instances):
    chosen = DOMAINS[domain].settings[setting]
    expected_class, mapping, relevance = CLASSES[method]
    transfer = transfer_of(domain, setting, method, few_instances)
    assert type(transfer) is (expected_class or type(None))
    if transfer is not None:
        use = "prior" if setting == BEST else "instances"
        drawn_once = use == "prior" and method == m.ONE_RANDOM
        assert transfer.use == use
        assert transfer.relevance == relevance
        if expected_class is TIMBREL:
            assert (transfer.mapping if isinstance(transfer.mapping, str) else None) == ("random" if drawn_once else mapping)
        its_source = few_instances[domain].unrelated if method == m.UNRELATED else few_instances[domain].own
        assert transfer.source is its_source
    env = make_task(DOMAINS[domain].target_id, max_episode_steps=25)
    with coarse_on_purpose():
        model = FittedRMax(env, transfer=transfer, seed=0, **METHODS[method].learner_in(DOMAINS[domain], chosen))
        model.learn(50)
    assert model.num_timesteps == 50
    assert isinstance(model.agent.model, KernelAverage) != (setting == BEST or method == m.NO_TRANSFER_BEST)
    env.close()


def test_the_papers_setting_is_that_of_its_tables(sources):
    car = transfer_of("mountain_car", PAPER, m.COMBREL_PLAIN, sources)
    robot = transfer_of("icub", PAPER, m.COMBREL_PLAIN, sources)
    for transfer, mappings, breadth in ((car, "paper_mountain_car", 0.4), (robot, "paper_icub", 0.1)):
        assert transfer.measured == "first_episode"
        assert (transfer.mappings, transfer.n_neighbors, transfer.breadth) == (mappings, 3, breadth)
        assert (transfer.breadth_decay, transfer.min_compliance, transfer.min_evidence) == (1.0, 0.0, 0.0)
    whole = transfer_of("mountain_car", PAPER, m.COMBREL_WHOLE, sources)
    assert (whole.neighbors, car.neighbors) == ("state_action", "action")


def test_the_mapping_of_a_person(sources):
    assert transfer_of("mountain_car", PAPER, m.TIMBREL_INTUITIVE, sources).mapping == intuitive_mapping()
    assert transfer_of("mountain_car", BEST, m.TIMBREL_INTUITIVE, sources).mapping == factored_mapping(2)


@pytest.mark.parametrize("setting", [PAPER, EXPLORE])
@pytest.mark.parametrize("domain", DOMAINS)
def test_one_random_mapping_is_drawn_by_the_seed(domain, setting, sources):
    drawn = [transfer_of(domain, setting, m.ONE_RANDOM, sources, seed).mapping for seed in range(5000, 5020)]
    again = [transfer_of(domain, setting, m.ONE_RANDOM, sources, seed).mapping for seed in range(5000, 5020)]
    assert drawn == again
    assert len(set(drawn)) > 10
    if setting == PAPER:
        # The other sets have too many to go through them all.
        assert set(drawn) <= set({"mountain_car": MappingSet.paper_mountain_car, "icub": MappingSet.paper_icub}[domain]())


def test_one_random_mapping_with_a_prior_is_drawn_by_the_seed(sources):
    def drawn(seed):
        transfer = transfer_of("mountain_car", BEST, m.ONE_RANDOM, sources)
        with coarse_on_purpose():
            return FittedRMax(make_task(MOUNTAIN_CAR.target_id), transfer=transfer, seed=seed).agent.transfer.describe_prior()

    assert drawn(0) == drawn(0)
    assert len({drawn(seed) for seed in range(4)}) > 1


def test_oracle_and_unrelated_source(sources):
    oracle = transfer_of("icub", PAPER, m.ORACLE, sources)
    assert len(oracle.mapping) == len(target_names(ICUB)[1])
    assert transfer_of("mountain_car", PAPER, m.UNRELATED, sources).mappings == "injective"
    assert sources["mountain_car"].unrelated.origin["env"] == ICUB.source_id
    assert sources["icub"].unrelated.origin["env"] == MOUNTAIN_CAR.source_id


class TestFrequentMapping:
    """The mapping that COMBREL used most, of made-up results."""

    def test_it_is_that_of_all_runs_of_combrel_together(self, sources):
        own = sources["icub"].own
        target_variables, target_actions = target_names(ICUB)
        good = f"{target_variables[1]}<-{own.state_names[0]}, {target_variables[2]}<-(-{own.state_names[1]})"
        bad = f"{target_variables[0]}<-{own.state_names[1]}"
        uses = [[action, own.action_names[k % len(own.action_names)], good, "", 10] for k, action in enumerate(target_actions)]
        other = [[target_actions[0], own.action_names[3], bad, "", 75]]
        results = [
            made_up("icub", m.COMBREL_PLAIN, 0, [9], uses=[*uses, *other]),
            made_up("icub", m.COMBREL_PLAIN, 1, [9], uses=[[target_actions[0], own.action_names[2], good, "", 15]]),
            # Another method's uses have no say.
            made_up("icub", m.UNRELATED, 0, [9], uses=[[target_actions[0], own.action_names[3], bad, "", 1000]]),
        ]
        found = frequent_mapping(results, ICUB, sources["icub"])
        expected_actions = [k % len(own.action_names) for k in range(len(target_actions))]
        # 15 of the second run, 10 of the first.
        expected_actions[0] = 2
        assert found == InterTaskMapping(
            state=tuple({1: 0, 2: 1}.get(k) for k in range(len(target_variables))),
            action=tuple(expected_actions),
            sign=tuple(-1 if k == 2 else 1 for k in range(len(target_variables))),
        )

    def test_without_a_use_the_error_says_what_helps(self, sources):
        results = [made_up("icub", m.COMBREL_PLAIN, 0, [9, 9])]
        with pytest.raises(ValueError, match=r"COMBREL has used no mapping within episodes=2.*use more --episodes"):
            frequent_mapping(results, ICUB, sources["icub"])


class TestPlan:
    def test_the_jobs_are_those_of_each_seed_and_method_and_go_to_other_processes(self, sources):
        (target,) = targets_of("fig2", PAPER)
        methods = methods_of([target], MOUNTAIN_CAR, PAPER)
        jobs = jobs_of(MOUNTAIN_CAR, PAPER, methods, sources["mountain_car"], 3, 7)
        assert Counter(job.method for job in jobs) == Counter(dict.fromkeys(target.methods["mountain_car"], 3) | {m.ORACLE: 0})
        assert {job.seed for job in jobs} == {5000, 5001, 5002}
        assert {job.n_episodes for job in jobs} == {7}
        assert len({job.name for job in jobs}) == len(jobs)
        assert {job.method for job in jobs if job.records_selections} == {m.COMBREL_PLAIN}

    def test_runs_of_combrel_come_with_its_most_frequent_mapping(self):
        (target,) = targets_of("fig5", PAPER)
        assert m.COMBREL_PLAIN in methods_of([target], ICUB, PAPER)

    @pytest.mark.parametrize("setting", SETTINGS)
    def test_all_targets_of_a_setting_need_methods_that_exist_there(self, setting):
        targets = targets_of("all", setting)
        assert {"fig2", "fig5", "fig6", "table5", "table6"} <= {target.name for target in targets}
        for target in targets:
            for domain in target.domains():
                assert set(methods_of([target], domain, setting)) <= EXISTING[domain.name, setting]

    @pytest.mark.parametrize(
        ("name", "setting", "message"),
        [
            ("fig7", PAPER, "target must be one of fig2, .*table6.* or all, got 'fig7'"),
            ("table1", PAPER, "got 'table1'"),
            ("fig3", BEST, "fig3 does not exist in setting 'best': with priors there is no relevance; use another --setting"),
            ("fig4", BEST, "fig4 does not exist in setting 'best'"),
            ("table2", BEST, "table2 does not exist in setting 'best'"),
            ("table4", BEST, "table4 does not exist in setting 'best'"),
            ("diagnosis", PAPER, "diagnosis does not exist in setting 'paper': it varies the breadth of setting 'explore'"),
        ],
    )
    def test_targets_that_do_not_exist(self, name, setting, message):
        with pytest.raises(ValueError, match=message):
            targets_of(name, setting)


def test_sources_are_loaded_again_and_learned_again_when_damaged(sources, sources_folder, prepare, tmp_path):
    folder = prepare(tmp_path / "output")
    damaged = folder / "sources" / "mountain_car.npz"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: len(whole) // 2])
    console = quiet()
    found = prepare_sources(MOUNTAIN_CAR, folder, console)
    assert "learned again" in console.file.getvalue()
    np.testing.assert_array_equal(found.own.states, sources["mountain_car"].own.states)
    np.testing.assert_array_equal(found.own.rewards, sources["mountain_car"].own.rewards)
    assert json.loads((folder / "settings.json").read_text()) == {}
