"""What transfer did, as a report: against plain computations, for every method, and after saving and loading."""

import dataclasses

import numpy as np
import pytest
from helpers import factored as f
from helpers.dashboard import NamedWalk
from helpers.own_method import Mine
from helpers.walk import METHODS as ON_WALK
from helpers.walk import small, walk_source

from sb3_combrel import COMBREL, MASTER, TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.transfer.outcome_evidence import MIN_IN_PART, N_PARTS, RegionErrors
from sb3_combrel.transfer.report import NotBoundError

TWO = f.copies_mapping(2)


def bound(transfer, n_variables=4, n_actions=5, seed=0):
    task = dataclasses.replace(f.target_task(n_variables, n_actions), takes_prior=True)
    transfer.bind(task, np.random.default_rng(seed))
    return transfer


def shown(transfer, transitions):
    for state, action, effect in zip(*transitions, strict=True):
        transfer.observe(state, int(action), -1.0, state + effect, False)
    return transfer


@pytest.fixture(scope="module")
def factored():
    """COMBREL after transitions of a target that is two copies of a noisy source, and these transitions."""
    transitions = f.walk(TWO, 200, seed=1)
    transfer = shown(bound(COMBREL(f.oscillator_source(noise=0.004), "factored", use="prior")), transitions)
    return transfer, transitions


def test_the_mapping_of_a_prior_is_named_with_compliances_and_errors_of_the_targets_transitions(factored):
    transfer, (states, actions, effects) = factored
    report, scale = transfer.report(), np.abs(effects).mean(axis=0) ** 2
    places = {0: [0, 1], 1: [2, 3]}
    assert [each.target_action for each in report.mappings] == [f"a{k}" for k in range(5)]
    assert report.mappings[3].mapping == "Wait on (s0, s1), Down on (s2, s3)"
    for a, each in enumerate(report.mappings):
        rows = actions == a
        used = {copy: TWO.copies[copy].action[a] for copy in (0, 1)}
        predicted = np.zeros((rows.sum(), 4))
        for copy, place in places.items():
            number = next(k for k, row in enumerate(transfer.source_prior.copies.state) if row[place].tolist() == [0, 1])
            predicted[:, place] = f.predicted_by(transfer.source_prior.copies, number, used[copy], states[rows])[:, place]
        squared = (effects[rows] - predicted) ** 2
        assert each.compliance == pytest.approx(np.exp(-(squared / scale).sum(axis=1)).mean(), rel=1e-3)
        assert each.no_change_compliance == pytest.approx(np.exp(-(effects[rows] ** 2 / scale).sum(axis=1)).mean())
        assert each.error == pytest.approx(squared.sum() / (effects[rows] ** 2).sum(), rel=1e-3)
        assert each.n_compared == rows.sum()
        assert each.compliance > each.next_best_compliance and each.error < each.next_best_error
        # One of the two copies is moved by another source action.
        ours, theirs = each.mapping.split(" on "), each.next_best.split(" on ")
        assert len(ours) == len(theirs) and ours != theirs
    # The next best division lacks a copy.
    assert report.next_best and not {"(s0, s1)", "(s2, s3)"} <= set(report.next_best.split(" and "))
    assert report.next_best_error > report.error


def test_the_sentence_does_not_give_the_error_on_all_steps_as_that_on_the_steps_compared():
    """With a source that has data of a half of the states alone, these are different steps."""
    source = f.oscillator_source(200)
    half = {name: getattr(source, name)[source.states[:, 0] > 0.5] for name in ("states", "actions", "rewards")}
    half |= {name: getattr(source, name)[source.states[:, 0] > 0.5] for name in ("next_states", "terminated")}
    mapping = f.copies_mapping(1)
    transfer = bound(TIMBREL(dataclasses.replace(source, **half), mapping, use="prior"), 2, 3)
    states, actions, effects = transitions = f.walk(mapping, 200)
    report = shown(transfer, transitions).report()
    predicted = transfer.prior(states, actions).effect
    assert report.error == pytest.approx(((effects - predicted) ** 2).sum() / (effects**2).sum())
    assert 0 < report.n_compared < 180 and report.error != pytest.approx(transfer.region_errors.error(), rel=0.1)
    judged, compared = report.sentence.split("; ")
    assert judged.endswith(f"its prediction error is {report.error:.2f} (no change: 1)")
    assert compared.startswith("where it has data it was worse than no change on ")
    assert f" of {report.n_compared:,} steps" in compared


def test_of_another_chooser_the_next_best_is_another_mapping_and_every_transition_is_measured():
    """MASTER chooses once, by errors, after more transitions than others measure one by one."""
    transfer = bound(MASTER(f.oscillator_source(200), n_random_steps=530, use="prior"), 2, 3)
    transitions = f.walk(f.copies_mapping(1), 530)
    shown(transfer, transitions)
    np.testing.assert_array_equal(transfer.source_prior.sums.n, np.bincount(transitions[1]))
    for each in transfer.report().mappings:
        assert each.next_best and each.next_best != each.mapping and each.next_best_error > each.error


@pytest.mark.filterwarnings("ignore:what was transferred")
def test_where_the_target_contradicts_a_source_is_said_by_action_variable_and_raw_range():
    def turned(states, actions):
        # In the upper part of the first variable everything goes the other way.
        return f.oscillate(states, actions) * np.where(states[:, :1] > 0.75, -1.0, 1.0)

    rng = np.random.default_rng(0)
    states, actions = rng.random((400, 2)), rng.integers(3, size=400)
    transfer = bound(TIMBREL(f.oscillator_source(), f.copies_mapping(1), use="prior"), 2, 3)
    shown(transfer, (states, actions, turned(states, actions)))
    report = transfer.report()
    found = [each for each in report.contradictions if each.variable == "s0"]
    assert {(each.low, each.high) for each in found} == {(0.75, 1.0)}
    assert {each.target_action for each in found} == {"a0", "a1", "a2"}
    # Twice the effect is missed.
    assert all(each.error == pytest.approx(4.0, rel=0.1) for each in found)
    assert report.n_worse == pytest.approx(0.25 * report.n_compared, rel=0.3) and "s0 from 0.75 to 1" in str(report)


def test_what_is_said_of_the_mapping_in_use_is_of_that_mapping_alone():
    """After a switch the errors are those that the new mapping would have made from the start."""
    wrong, right = f.walk(f.copies_mapping(2, [0, 2, 1, 3]), 40, seed=2), f.walk(TWO, 500, seed=3)
    transfer = bound(COMBREL(f.oscillator_source(), "factored", use="prior"))
    shown(transfer, wrong)
    before = transfer.describe_prior()
    shown(transfer, right)
    assert transfer.describe_prior() != before and transfer.statistics()["transfer/switches"] >= 1
    prior, errors = transfer.source_prior, RegionErrors(transfer.task)
    for state, action, effect in zip(*(np.concatenate(parts) for parts in zip(wrong, right, strict=True)), strict=True):
        predicted, _, weight = prior.copies.predict(prior._used, state[None], np.array([action]))
        if weight[0] >= prior.task.exploration_threshold:
            errors.note(state, int(action), effect, predicted[0])
    np.testing.assert_allclose(prior.errors.sums, errors.sums, rtol=1e-6, atol=1e-12)


def test_errors_by_place_are_those_of_a_loop():
    rng, task = np.random.default_rng(0), f.target_task(2, 3)
    errors, rows = RegionErrors(task), []
    for _ in range(300):
        state, effect, predicted = rng.uniform(-0.1, 1.1, 2), *(0.1 * rng.normal(size=(2, 2)))
        rows.append((state, int(rng.integers(3)), effect, predicted))
        errors.note(*rows[-1])
    for action in range(3):
        its = [(s, e, p) for s, a, e, p in rows if a == action]
        squared = sum(((e - p) ** 2).sum() for _, e, p in its), sum((e**2).sum() for _, e, _ in its)
        assert errors.errors()[action] == pytest.approx(squared[0] / squared[1])
    expected = set()
    for a in range(3):
        for v in range(2):
            for part in range(N_PARTS):
                last = part == N_PARTS - 1
                inside = [
                    (e, p)
                    for s, b, e, p in rows
                    if a == b and (s[v] >= part / N_PARTS or part == 0) and (s[v] < (part + 1) / N_PARTS or last)
                ]
                missed, moved = (
                    sum((x**2).sum() for x in each) for each in zip(*((e - p, e) for e, p in inside), strict=True)
                )
                if len(inside) >= MIN_IN_PART and missed > moved:
                    expected.add((f"a{a}", f"s{v}", part / N_PARTS, len(inside), round(missed / moved, 9)))
    found = errors.contradictions()
    listed = {(e.target_action, e.variable, e.low, e.n_compared, round(e.error, 9)) for e in found}
    assert listed <= expected and len(found) == min(8, len(expected)) and len(found) > 0


def test_steps_that_rest_on_instances_are_those_whose_action_had_some(monkeypatch):
    rested, last = [], {}

    def noted(self, transferred):
        last["length"] = transferred.length.copy()
        note_use(self, transferred)

    def observed(self, state, action, *rest):
        rested.append(bool(last.get("length", np.zeros(2))[action] > 0))
        last.clear()
        observe(self, state, action, *rest)

    note_use, observe = TIMBREL.note_use, TIMBREL.observe
    monkeypatch.setattr(TIMBREL, "note_use", noted)
    monkeypatch.setattr(TIMBREL, "observe", observed)
    report = small(transfer=ON_WALK["TIMBREL"](), model_breadth=0.03, resolution=5).learn(60).transfer.report()
    assert (report.n_steps, report.n_rested) == (60, sum(rested)) and sum(rested) > 0
    assert report.n_compared == sum(rested) == sum(each.n_compared for each in report.mappings)


def test_the_confidence_of_combrel_is_that_of_its_choices_and_they_are_the_best():
    source = SourceInstances.record(None, NamedWalk(), n_instances=200, seed=0)
    transfer = COMBREL(source, "signed_injective", use="instances", min_compliance=1.0)
    model = small(NamedWalk(), transfer=transfer, degree=0).learn(80)
    selector = model.transfer._instances.selector
    # Choices that are due wait until there is more to renew, or an episode ends.
    selector.end_episode()
    selector.changed(np.zeros((2, len(selector.task.sample_states)), dtype=np.bool_))
    report = model.transfer.report()
    for action, each in enumerate(report.mappings):
        n = len(selector.task.sample_states)
        pairs = action * n + np.flatnonzero(selector.choices()[action * n : (action + 1) * n] >= 0)
        assert 0 < len(pairs) <= 500 and each.compliance == pytest.approx(selector.mean_compliance(pairs).mean())
        # What does not exceed the no-change baseline is not chosen.
        assert each.compliance >= each.next_best_compliance and each.compliance > each.no_change_compliance
    assert report.mappings[1].target_action == "forth" and "place<-" in report.mappings[1].mapping
    uses = model.transfer.uses()
    of_action = {c: n for c, n in uses.items() if model.transfer.candidate(c).target_action == 1}
    assert report.mappings[1].share == max(of_action.values()) / sum(of_action.values())
    assert report.mappings[1].n_mappings == len(of_action)


SOURCE = walk_source()


def test_reporting_changes_nothing():
    models = [small(transfer=COMBREL(SOURCE, use="instances")).learn(30) for _ in range(2)]
    str(models[0].transfer.report())
    one, other = (model.learn(20, reset_num_timesteps=False).get_parameters()["policy"] for model in models)
    assert all(np.array_equal(one[name], other[name]) for name in one)


def test_results_that_are_not_there_yet_are_refused_with_what_to_do():
    for unbound in (COMBREL(SOURCE), Mine()):
        with pytest.raises(NotBoundError, match=r"after model = FittedRMax\(env, transfer=...\).learn\(\), .* model.transfer"):
            unbound.report()
    unbound = COMBREL(SOURCE)
    for name in ("mapping_counts", "choices", "statistics", "describe_prior", "sources"):
        with pytest.raises(NotBoundError, match="has no results"):
            getattr(unbound, name)()
    assert not hasattr(unbound, "sources")
    with pytest.raises(ValueError, match=r"nothing to report before learning: call model.learn"):
        small(transfer=unbound).transfer.report()


def test_an_object_shows_its_arguments():
    text = repr(COMBREL(SOURCE, n_neighbors=5, use="instances"))
    assert text == f"COMBREL(source={SOURCE!r}, mappings='injective', use='instances', n_neighbors=5)"
    given = TIMBREL(SOURCE, InterTaskMapping((0, 1), (0, 1)), breadth=0.2)
    assert repr(given) == f"TIMBREL(source={SOURCE!r}, mapping=InterTaskMapping(state=(0, 1), action=(0, 1)), breadth=0.2)"
    assert repr(COMBREL(SOURCE)) == f"COMBREL(source={SOURCE!r})"
    assert repr(Mine()) == "Mine()" and repr(Mine(3.0)) == "Mine(reward=3.0)"


def test_it_says_why_the_sources_values_bound_nothing():
    def report_of(source):
        env = NamedWalk()
        return small(env, transfer=COMBREL(source), degree=1).learn(150).transfer.report()

    source = SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)
    own = report_of(source)
    assert own.why_unbounded == "" and own.bound[0] <= own.bound[1] <= own.bound[2] <= 0.0
    assert all(0.0 <= each.no_source <= 1.0 for each in own.mappings) and "; from " in str(own)
    wrong = report_of(dataclasses.replace(source, rewards=-source.rewards))
    assert not wrong.bounds_values and wrong.why_unbounded == "its rewards are not the target's"
    assert "do not bound that of what is unknown: its rewards are not the target's." in str(wrong)


def test_a_source_that_is_taken_for_nothing_is_said_to_be():
    source = SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)
    noise = np.random.default_rng(0).uniform(source.low, source.high, source.states.shape)
    unrelated = dataclasses.replace(source, next_states=noise, terminated=np.zeros(150, dtype=np.bool_))
    report = small(NamedWalk(), transfer=COMBREL(unrelated), degree=1).learn(150).transfer.report()
    assert [each.mapping for each in report.mappings] == ["nothing", "nothing"]
    assert report.why_unbounded == "no mapping explains the target better than that nothing changes"
    assert report.sentence in str(report) and report.sentence.startswith("The source is taken for nothing")


def test_a_mapping_that_was_left_to_chance_is_shown():
    assert repr(TIMBREL(walk_source(), "random", use="prior")).endswith("mapping='random', use='prior')")
