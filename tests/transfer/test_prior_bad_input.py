"""Priors that cannot work: an error that says what to change, at once or when the model is made."""

import numpy as np
import pytest
from helpers import factored as f

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, InterTaskMapping
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import describe_transfer, make_transfer, restore_transfer

SOURCE = f.oscillator_source(60)
TWO = f.copies_mapping(2)


def bind(transfer, d=4, n_actions=5):
    transfer.bind(f.target_task(d, n_actions), np.random.default_rng(0))
    return transfer


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: COMBREL(SOURCE, use="model"), r'use must be "instances" or "prior", got \'model\''),
        (lambda: TIMBREL(SOURCE, use=None), "use must be"),
        (lambda: COMBREL(SOURCE, "factored"), 'factored mappings need use="prior", got use="instances"'),
        (lambda: TIMBREL(SOURCE, TWO), 'factored mappings need use="prior"'),
        (lambda: TIMBREL(SOURCE, {"copies": []}), 'factored mappings need use="prior"'),
        (lambda: TIMBREL(SOURCE, "random", mappings="signed_factored"), 'factored mappings need use="prior"'),
        (lambda: TIMBREL(SOURCE, "pool", use="prior"), 'mapping must be a mapping or "random"'),
        (lambda: TIMBREL(SOURCE, TWO, use="prior", relevance=True), "relevance must be False"),
        (lambda: COMBREL(SOURCE, use="prior", source_breadth=0.0), "source_breadth must be a number above 0, got 0.0"),
        (lambda: COMBREL(SOURCE, use="prior", source_breadth=float("nan")), "source_breadth must be a number above 0"),
    ],
)
def test_arguments_that_do_not_fit_each_other_are_refused_at_once(make, says):
    with pytest.raises(ValueError, match=says):
        make()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: TIMBREL(SOURCE, f.copies_mapping(3), use="prior"), "state must have 4 entries"),
        (lambda: TIMBREL(SOURCE, {"copies": [{"state": [0, 1, None, 2], "action": [0] * 5}]}, use="prior"), "from 0 to 1"),
        (lambda: TIMBREL(SOURCE, {"copies": [], "more": 1}, use="prior"), "dict of copies"),
        (lambda: TIMBREL(SOURCE, {"copies": []}, use="prior"), "at least one"),
        (lambda: TIMBREL(SOURCE, [InterTaskMapping([0, 1, None, None], [0] * 5)] * 2, use="prior"), "one for each of the 5"),
        (lambda: COMBREL(SOURCE, "factorised", use="prior"), "mappings must be one of.*factored"),
        (lambda: COMBREL([], "factored", use="prior"), "source must be"),
    ],
)
def test_mappings_that_do_not_fit_the_tasks_are_refused_when_bound(make, says):
    with pytest.raises(ValueError, match=says):
        bind(make())


def test_sets_that_are_too_large_are_refused_with_what_to_do():
    with pytest.raises(ValueError, match="at most 12 state variables, got 13; give a FactoredMapping"):
        bind(COMBREL(SOURCE, "factored", use="prior"), d=13)
    rng = np.random.default_rng(0)
    d = 6
    wide = type(SOURCE)(rng.random((9, d)), [0] * 9, [0] * 9, rng.random((9, d)), [False] * 9, [0] * d, [1] * d, 1)
    with pytest.raises(ValueError, match=r"has \d+ copies .* more than the 2000"):
        bind(COMBREL(wide, "factored", use="prior"), d=6)


def test_a_kernel_average_takes_no_prior():
    for transfer in (COMBREL(SOURCE, "factored", use="prior"), TIMBREL(SOURCE, TWO, use="prior")):
        with pytest.raises(
            ValueError, match=r"use=\"prior\"\) needs the local linear model, FittedRMax\(degree=1\), got degree=0"
        ):
            transfer.check_degree(0)
        transfer.check_degree(1)
    COMBREL(SOURCE).check_degree(0)


def test_a_method_that_says_it_has_a_prior_needs_one():
    class Promising(Transfer):
        use = "prior"

        def observe(self, *transition):
            pass

        def transferred(self, states, actions, own_weight):
            raise AssertionError("never asked")

    with pytest.raises(NotImplementedError, match="Promising"):
        Promising().prior(np.zeros((1, 2)), np.zeros(1, dtype=np.int64))
    assert Promising().prior_version() == 0


def test_there_is_no_prior_to_describe_without_one():
    transfer = bind(COMBREL(SOURCE))
    with pytest.raises(ValueError, match='use must be "prior"'):
        transfer.describe_prior()


def test_dicts_as_in_a_yaml_file_make_the_same(tmp_path):
    path = str(SOURCE.save(tmp_path / "source.npz"))
    copies = [{"state": list(each.state), "action": list(each.action)} for each in TWO.copies]
    given = make_transfer({"TIMBREL": {"source": path, "mapping": {"copies": copies}, "use": "prior"}})
    direct = TIMBREL(SOURCE, TWO, use="prior")
    states, actions = np.full((5, 4), 0.4), np.arange(5)
    predictions = [bind(each).prior(states, actions) for each in (given, direct)]
    assert all(np.array_equal(one, other) for one, other in zip(*predictions, strict=True))
    chosen = make_transfer({"sb3_combrel.COMBREL": {"source": path, "mappings": "factored", "use": "prior"}})
    assert (chosen.use, chosen.mappings) == ("prior", "factored")


@pytest.mark.parametrize(
    "make",
    [
        lambda: TIMBREL(SOURCE, TWO, use="prior", source_breadth=0.3),
        lambda: COMBREL(SOURCE, "signed_factored", use="prior", max_transitions=50),
        lambda: COMBREL(SOURCE, FactoredMapping([TWO.copies[1]]), use="prior"),
    ],
)
def test_a_description_makes_the_same_object_again(make):
    ours = bind(make())
    theirs = restore_transfer(describe_transfer(ours))
    plain = describe_transfer(theirs)
    assert plain == describe_transfer(make())
    assert type(theirs) is type(ours) and bind(theirs).describe_prior() == ours.describe_prior()
