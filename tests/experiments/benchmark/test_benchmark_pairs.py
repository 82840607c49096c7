"""The pairs of the benchmark: their tasks, their known mappings, and which choices count as those."""

from contextlib import closing
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.experiments.benchmark.known import errors_of
from sb3_combrel.experiments.benchmark.methods import FACTORED, METHODS, DoesNotFit, Method
from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.benchmark.pairs import (
    ACTIONS,
    ORDER,
    PAIRS,
    SIGNS,
    make_car,
    make_disguised_car,
    make_pendulum_of_three,
)
from sb3_combrel.experiments.benchmark.runs import has_mapping, jobs_of, known_share
from sb3_combrel.experiments.tasks.cart_with_pendulum import make_cart_with_pendulum
from sb3_combrel.experiments.tasks.disguised import disguise
from sb3_combrel.runs.described import described
from sb3_combrel.runs.job import chosen_on_purpose, make_env
from sb3_combrel.runs.runner import Backend, run_missing
from sb3_combrel.transfer.candidates import MappedVariables


def random_instances(task, n=300, seed=0, **options):
    """Instances of random actions, which take no time to learn."""
    with closing(make_env(task)) as env, chosen_on_purpose():
        return SourceInstances.record(None, env, n, seed, **options)


@pytest.fixture(scope="module")
def sources():
    """For each pair instances of random actions in tasks of the same spaces as its sources."""
    from sb3_combrel.experiments.tasks.cart_pole import LEARNER, make_cart_pole
    from sb3_combrel.experiments.tasks.point_robot import make_point_robot

    robot = random_instances(lambda: make_point_robot(2, 0.003, "random"))
    return {
        "mountain-car": (random_instances("combrel/MountainCar2D-v0"),),
        "icub": (random_instances("combrel/ICubTorsoStrike-v0"),),
        "mirrored-car": (random_instances(make_car),),
        "cart-pole": (random_instances(make_cart_pole, bounds=LEARNER["bounds"]),),
        "pendulum-acrobot": (random_instances(make_pendulum_of_three),),
        "point-robot": (robot,),
        "two-sources": tuple(random_instances(lambda p=p: make_cart_with_pendulum(p)) for p in ("cart", "pendulum")),
        "nothing-in-common": (robot,),
    }


class TestEveryPair:
    @pytest.mark.parametrize("name", PAIRS)
    def test_episodes_have_a_limit(self, name):
        with closing(PAIRS[name].make_target()) as env:
            limit = env.get_wrapper_attr("_max_episode_steps")
            assert limit <= (PAIRS[name].n_steps or limit)

    def test_known_mappings_have_the_variables_and_actions_of_their_tasks(self, sources):
        for name, pair in PAIRS.items():
            pair.check_known(sources[name])

    @pytest.mark.parametrize("name", ["mountain-car", "mirrored-car"])
    def test_combrel_is_run_once_where_its_default_is_what_it_is_told(self, name, sources):
        def bound(method):
            transfer = METHODS[method].make(sources[name][0], PAIRS[name])
            with closing(PAIRS[name].make_target()) as env, chosen_on_purpose():
                return FittedRMax(env, transfer=transfer, seed=0, **PAIRS[name].learner).agent.transfer.arguments()

        left_open, told = bound("COMBREL"), bound(FACTORED)
        assert ({**left_open, "source": 0} == {**told, "source": 0}) == (METHODS["COMBREL"].same_as(PAIRS[name]) == FACTORED)

    @pytest.mark.parametrize(
        "name", ["mirrored-car", *(pytest.param(n, marks=pytest.mark.long) for n in [*PAIRS][3:]), "icub"]
    )
    @pytest.mark.parametrize("method", METHODS)
    def test_every_method_fits_or_says_why_not(self, name, method, sources):
        pair, given = PAIRS[name], sources[name]
        one_source = dict.fromkeys(("soft-homomorphism", "sparse-coding", "three-way-RBM"), len(given) > 1)
        unfit = {"oracle": pair.known is None, "TIMBREL": pair.known_by_action is None or len(given) > 1} | one_source
        try:
            transfer = METHODS[method].make(given[0] if len(given) == 1 else list(given), pair)
        except DoesNotFit as error:
            assert unfit.get(method, False) and ("nobody knows" in str(error) or "one source" in str(error))
            return
        assert not unfit.get(method, False)
        with closing(pair.make_target()) as env, chosen_on_purpose():
            if name == "pendulum-acrobot" and method in ("sparse-coding", "three-way-RBM"):
                with pytest.raises(ValueError, match="does not support periodic state variables"):
                    FittedRMax(env, transfer=transfer, seed=0, **pair.learner)
                return
            learner = FittedRMax(env, transfer=transfer, seed=0, **pair.learner)
        assert (learner.agent.transfer is None) == (method == "none")

    @pytest.mark.parametrize("name", [name for name, pair in PAIRS.items() if pair.known is not None])
    def test_the_oracle_chooses_the_known_mapping_only(self, name, sources):
        pair, given = PAIRS[name], sources[name]
        transfer = METHODS["oracle"].make(given[0] if len(given) == 1 else list(given), pair)
        with closing(pair.make_target()) as env, chosen_on_purpose():
            bound = FittedRMax(env, transfer=transfer, seed=0, **pair.learner).agent.transfer
        for action in range(bound.task.n_actions):
            mapped = bound.mapped_variables(int(bound.choices()[action * len(bound.task.sample_states)]))
            assert mapped.target_action == action and pair.agrees(mapped)


class TestKnownMappings:
    @pytest.mark.parametrize("name", ["mirrored-car", "two-sources", "icub"])
    def test_predicts_nearly_as_well_as_what_complies_best(self, name, sources):
        pair = PAIRS[name]
        found = errors_of(pair, sources[name], random_instances(pair.target, 400, seed=1))
        assert found.known < 0.5 and found.known < 1.3 * found.chosen + 0.02

    def test_another_mapping_predicts_worse(self, sources):
        pair, target = PAIRS["mirrored-car"], random_instances(make_disguised_car, 300, seed=1)
        right = errors_of(pair, sources["mirrored-car"], target)
        for wrong in (disguise(ORDER, (1, 1), ACTIONS), disguise(ORDER, SIGNS, (0, 1, 2)), disguise((0, 1), SIGNS, ACTIONS)):
            other = replace(pair, known=FactoredMapping((wrong,)))
            assert errors_of(other, sources["mirrored-car"], target).known > 1.5 * right.known
        # What COMBREL chooses is the known one, and both ways of computing its error agree.
        assert right.chosen == pytest.approx(right.known, rel=1e-6)

    def test_nobody_knows_one(self):
        with pytest.raises(ValueError, match="known must be a mapping: nobody knows the mapping"):
            errors_of(PAIRS["nothing-in-common"], (random_instances(make_car, 50),), random_instances(make_car, 50))


def mapped(action, source, variable, sign, used):
    return MappedVariables(action, *(np.array(each) for each in (source, variable, sign, used)))


class TestAgreement:
    """Target variables x, y; under action 0 the known mapping is of x, under action 1 of a mirrored y."""

    PAIR = Pair(
        "agreement",
        "Made up.",
        (recorded("nothing", "CartPole-v1"),),
        "CartPole-v1",
        n_episodes=1,
        known_by_action=(InterTaskMapping((1, None), (2, 0)), InterTaskMapping((None, 0), (0, 3), (1, -1))),
    )

    @pytest.mark.parametrize(
        "decision, agrees",
        [
            (mapped(0, [0, -1], [1, -1], [1, 0], [2, -1]), True),
            (mapped(0, [0, 0], [1, 0], [1, 1], [2, 5]), True),
            (mapped(0, [0, -1], [0, -1], [1, 0], [2, -1]), False),
            (mapped(0, [0, -1], [1, -1], [-1, 0], [2, -1]), False),
            (mapped(0, [0, -1], [1, -1], [1, 0], [1, -1]), False),
            (mapped(0, [1, -1], [1, -1], [1, 0], [2, -1]), False),
            (mapped(0, [-1, -1], [-1, -1], [0, 0], [-1, -1]), False),
            (mapped(1, [-1, 0], [-1, 0], [0, -1], [-1, 3]), True),
            (mapped(1, [-1, 0], [-1, 0], [0, 1], [-1, 3]), False),
        ],
    )
    def test_only_what_the_action_moves_counts(self, decision, agrees):
        assert self.PAIR.agrees(decision) is agrees

    def test_the_share_is_weighted_by_uses(self):
        class Chooser:
            def uses(self):
                return {0: 3, 1: 1}

            def mapped_variables(self, number):
                return mapped(0, [0, -1], [1 - number, -1], [1, 0], [2, -1])

        assert known_share(self.PAIR, Chooser()) == 0.75
        assert known_share(self.PAIR, object()) is None and known_share(self.PAIR, None) is None
        assert known_share(replace(self.PAIR, known_by_action=None), Chooser()) is None
        Chooser.uses = lambda self: {}
        assert known_share(self.PAIR, Chooser()) is None


def carried_out(pair, method, sources):
    """The result of one run of the mirrored car."""
    return run_missing(jobs_of([pair], [method], [0], {(pair.name, 0): sources["mirrored-car"]}), backend=Backend(n_jobs=1))[0]


class TestStepsToAMapping:
    class Chooser:
        """Names a candidate for one of three pairs from some number of questions on."""

        def __init__(self, makes_choices, n_before):
            self.makes_choices, self.left = makes_choices, n_before

        def choices(self):
            self.left -= 1
            return np.array([-1, 4 if self.left < 0 else -1, -1])

        def uses(self):
            self.left -= 1
            return {4: 1} if self.left < 0 else {}

    @pytest.mark.parametrize("makes_choices", [True, False])
    def test_a_mapping_is_there_when_a_candidate_is_named(self, makes_choices):
        transfer = self.Chooser(makes_choices, 2)
        assert [has_mapping(transfer) for _ in range(4)] == [False, False, True, True]

    def test_of_combrel_are_its_first_ten_transitions(self, sources):
        """A prior is chosen after ten, which the recorder sees after the next step at the latest."""
        pair = replace(PAIRS["mirrored-car"], n_steps=250)
        for name, steps in (("COMBREL-factored", (10, 11)), ("COMBREL-instances", (1, 3)), ("oracle", (None,))):
            found = carried_out(pair, METHODS[name], sources)
            assert found.more["mapping_steps"] in steps and found.n_steps == 250

    @pytest.mark.parametrize(
        ("name", "steps"),
        [
            ("MASTER", 100),
            pytest.param("soft-homomorphism", 10, marks=pytest.mark.long),
            pytest.param("three-way-RBM", 200, marks=pytest.mark.long),
        ],
    )
    def test_of_methods_that_learn_a_mapping_are_those_of_their_sample(self, name, steps, sources):
        pair = replace(PAIRS["mirrored-car"], n_steps=250)
        assert carried_out(pair, METHODS[name], sources).more["mapping_steps"] == steps

    def test_a_method_may_say_what_it_spends(self, sources):
        class Spender(COMBREL):
            def mapping_steps(self):
                return 77

        pair, method = replace(PAIRS["mirrored-car"], n_steps=250), Method("spender", "", lambda source, pair: Spender(source))
        assert carried_out(pair, method, sources).more["mapping_steps"] == 77


def test_a_budget_without_the_end_of_an_episode_is_an_error(sources):
    found = carried_out(replace(PAIRS["mirrored-car"], n_steps=100), METHODS["none"], sources)
    assert "no episode has ended within n_steps=100" in found.error and "misfit" not in found.more


def test_a_learner_that_cannot_be_made_is_no_misfit_of_the_method(sources):
    found = carried_out(replace(PAIRS["mirrored-car"], learner={"model_breadth": -1.0}), METHODS["COMBREL"], sources)
    assert found.error.startswith("ValueError: model_breadth must") and "misfit" not in found.more


class TestMappedVariables:
    @pytest.mark.parametrize("use", ["instances", "prior"])
    def test_of_a_given_mapping_with_mirrored_variables(self, use, sources):
        source, mapping = sources["mirrored-car"][0], disguise(ORDER, SIGNS, ACTIONS)
        given = FactoredMapping((mapping,)) if use == "prior" else mapping
        with closing(make_disguised_car()) as env:
            bound = FittedRMax(env, transfer=TIMBREL(source, given, use=use), seed=0).agent.transfer
        n_points = len(bound.task.sample_states)
        for action in range(3):
            found = bound.mapped_variables(int(bound.choices()[action * n_points]))
            assert found.target_action == action and found.action.tolist() == [ACTIONS[action]] * 2
            assert (found.source.tolist(), found.variable.tolist(), found.sign.tolist()) == ([0, 0], list(ORDER), list(SIGNS))

    def test_agree_with_the_names_of_all_candidates(self, sources):
        """Of two sources, one of which has a variable left out: by the text that says the same."""
        given = list(sources["two-sources"])
        with closing(PAIRS["two-sources"].make_target()) as env:
            bound = FittedRMax(env, transfer=COMBREL(given, "injective", use="instances"), seed=0).agent.transfer
        for number in range(0, len(bound.candidates), 7):
            found, parts = bound.mapped_variables(number), bound.candidate(number)
            has = found.source >= 0
            (source,) = set(found.source[has].tolist())
            assert found.target_action == parts.target_action
            assert {given[source].action_names[a] for a in found.action[has]} == {parts.source_action}
            for v, name in enumerate(bound.task.state_names):
                words = f"{name}<-{given[source].state_names[found.variable[v]]}" if has[v] else f"{name}<-"
                assert (words.replace("<-", "") in parts.state_mapping.replace("<-", "").replace(" ", "")) or not has[v]
            assert (found.variable[~has] == -1).all() and (found.sign[~has] == 0).all() and (found.action[~has] == -1).all()


SAME, FOUR = InterTaskMapping((0, 1), (0, 1)), InterTaskMapping((0, 1, 2, 3), (0, 1))


class TestPairArguments:
    @pytest.mark.parametrize(
        "options, words",
        [
            ({"name": "a b"}, 'name must be of letters, digits, "-", "_" and ".", got'),
            ({"n_steps": 5}, "either n_steps or n_episodes must be given, got 5 and 1"),
            ({"n_episodes": None}, "got None and None"),
            ({"n_episodes": 0}, "n_episodes must be .* got 0"),
            ({"threshold": np.nan}, "threshold must be .* got nan"),
            ({"sources": ()}, "sources must be a tuple of at least one Source"),
            ({"sources": recorded("s", "CartPole-v1")}, r"sources must be .* a tuple of one has a comma, \(recorded"),
            ({"target": gym.Env()}, "p: target must be the id of an environment or a function that makes one, .* got <"),
            ({"known": ((0, 1), (0, 1))}, "p: known must be a factored mapping, a sequence .* got"),
            ({"known": (SAME, FactoredMapping((SAME,)))}, "p: known must be a factored mapping, a sequence .* got"),
            ({"known_by_action": {"state": [0], "action": [0]}}, "p: known_by_action must be an InterTaskMapping, .* got"),
            ({"known": (FactoredMapping((disguise(ORDER, SIGNS, ACTIONS),)),) * 2}, "each of the 1 sources, got 2"),
            ({"known_by_action": (SAME,) * 2, "sources_by_action": (0,)}, "sources_by_action must .* 2 mappings .* got 1"),
            ({"known_by_action": SAME, "sources_by_action": (0, 1)}, r"numbers of the 1 sources, .*, got \(0, 1\)"),
        ],
    )
    def test_wrong_ones_are_named(self, options, words):
        given = {"name": "p", "description": "", "sources": (recorded("s", "CartPole-v1"),), "target": "CartPole-v1"}
        with pytest.raises(ValueError, match=words):
            Pair(**{**given, "n_episodes": 1, **options})

    @pytest.mark.parametrize(
        ("by_action", "numbers", "words"),
        [
            (FOUR, (), None),
            ((FOUR,) * 2, (0, 0), None),
            (FOUR, (0,), "sources_by_action must have one number for each of the 2 target actions, or none, got 1"),
            ((FOUR,), (), "known_by_action must have one mapping for each of the 2 target actions, got 1"),
            (SAME, (), "known_by_action: state must have 4 entries"),
            (InterTaskMapping((0,) * 4, (0, 2)), (), "known_by_action: action must hold indices from 0 to 1"),
            (InterTaskMapping({"x": "s0"}, {"a0": "a0", "a1": "a1"}), (), "known_by_action: state must hold .*, got 'x'"),
        ],
    )
    def test_a_known_mapping_must_have_the_variables_and_actions_of_both_tasks(self, by_action, numbers, words):
        known = {"known_by_action": by_action, "sources_by_action": numbers}
        pair = Pair("p", "", (recorded("s", "CartPole-v1"),), "CartPole-v1", n_episodes=1, **known)
        pair.check_known(())
        source = (random_instances("CartPole-v1", 20),)
        if words is None:
            pair.check_known(source)
            replace(pair, target=lambda: 1 / 0, known_by_action=SAME, sources_by_action=()).check_known(source)
        else:
            with pytest.raises(ValueError, match=f"^p: {words}"):
                pair.check_known(source)

    def test_names_in_a_known_mapping_become_numbers(self):
        turned = InterTaskMapping({"s3": "s1", "s0": "s2"}, {"a0": "a1", "a1": "a0"}, {"s0": -1})
        source = (random_instances("CartPole-v1", 20),)
        for given in (turned, (turned, FOUR)):
            pair = Pair("p", "", (recorded("s", "CartPole-v1"),), "CartPole-v1", n_episodes=1, known_by_action=given)
            known = pair.check_known(source).known_by_action
            first = known if given is turned else known[0]
            assert first == InterTaskMapping((2, None, None, 1), (1, 0), (-1, 1, 1, 1))
            assert given is turned or known[1] == FOUR

    def test_a_learner_that_does_not_exist(self):
        with pytest.raises(ValueError, match="learner must be one of fitted_rmax, q_learning, got 'sarsa'"):
            recorded("s", "CartPole-v1", "sarsa")

    def test_settings_tell_pairs_apart(self):
        one, other = (recorded("s", "CartPole-v1", n_episodes=n) for n in (5, 6))
        assert described(one.learn) != described(other.learn)
        assert PAIRS["icub"].settings() != replace(PAIRS["icub"], n_steps=4999).settings()
        assert PAIRS["icub"].settings() == replace(PAIRS["icub"], description="In other words.").settings()

    def test_settings_are_the_same_in_another_process(self):
        class Maker:
            def __call__(self):
                return gym.make("CartPole-v1")

        # Two objects have two places in memory, as one object has in two processes.
        one, other = (Pair("p", "", (recorded("s", Maker()),), Maker(), n_episodes=1) for _ in range(2))
        assert one.settings() == other.settings()
