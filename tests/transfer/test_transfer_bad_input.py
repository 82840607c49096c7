"""Sources, mappings and arguments of transfer that cannot work: an error when the model is made, that says what to change."""

import numpy as np
import pytest
from gymnasium import Env, spaces
from helpers import naive_transfer as naive

from sb3_combrel import COMBREL, TIMBREL, FittedRMax
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet


class Untouched(Env):
    """A task with three variables and two actions that nobody may step in."""

    observation_space = spaces.Box(-1.0, 1.0, (3,), dtype=np.float64)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        raise AssertionError("the error should have come before")

    step = reset


@pytest.fixture
def source():
    return naive.random_source(np.random.default_rng(0), 30, 2, 2)


def refused(transfer, *says, error=ValueError):
    with pytest.raises(error) as caught:
        FittedRMax(Untouched(), transfer=transfer() if callable(transfer) else transfer, resolution=3)
    for words in says:
        assert words in str(caught.value)


METHODS = [COMBREL, TIMBREL]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("mapping", "says"),
    [
        (InterTaskMapping([0, None, 1, None], [0, 1]), ["state must have 3 entries", "got 4"]),
        (InterTaskMapping([0, 1], [0, 1]), ["state must have 3 entries", "got 2"]),
        (InterTaskMapping([0, None, 1], [0, 1, 1]), ["action must have 2 entries", "got 3"]),
        (InterTaskMapping([0, None, 2], [0, 1]), ["state must hold indices from 0 to 1", "got 2"]),
        (InterTaskMapping([0, None, 1], [0, 2]), ["action must hold indices from 0 to 1", "got 2"]),
    ],
    ids=["long state", "short state", "long action", "no such variable", "no such action"],
)
def test_a_mapping_that_does_not_fit_the_spaces_is_refused(method, mapping, says, source):
    refused(method(source, mapping), *says)
    refused(method(source, [mapping, mapping]), *says)
    refused(method(source, {"state": list(mapping.state), "action": list(mapping.action)}), *says)


def test_a_set_that_does_not_fit_the_spaces_is_refused(source):
    refused(COMBREL(source, MappingSet.injective(2, 4, 2, 2)), "must", "3", "4")
    refused(COMBREL(source, "paper_mountain_car"), "must", "3", "4")
    refused(TIMBREL(source, "pool", mappings=MappingSet.injective(2, 3, 3, 2)), "indices from 0 to 1", "got 2")


def test_an_unknown_set_is_refused_with_the_names_of_those_that_exist(source):
    refused(lambda: COMBREL(source, "bijective"), "mappings must be one of", "injective", "paper_icub", "'bijective'")
    refused(lambda: COMBREL(source, []), "mappings must hold at least one")
    refused(lambda: COMBREL(source, 7), "mappings must be", "7")
    refused(lambda: COMBREL(source, [7]), "mappings must be", "7")
    refused(lambda: COMBREL(source, {"state": [0, None, 1]}), "dict of state, action", "[0, None, 1]")


def test_timbrel_needs_one_mapping_or_one_for_each_action(source):
    fits = InterTaskMapping([0, None, 1], [0, 1])
    refused(TIMBREL(source, [fits] * 3), "mapping must be one mapping or one for each of the 2 target actions", "got 3")
    refused(lambda: TIMBREL(source, "best"), "mapping must be", '"random" or "pool"', "'best'")
    refused(lambda: TIMBREL(source, []), "mappings must hold at least one")


@pytest.mark.parametrize("method", METHODS)
def test_a_source_file_that_is_missing_damaged_or_of_another_task_is_refused(method, source, tmp_path):
    refused(lambda: method(tmp_path / "nowhere.npz"), "nowhere.npz", "SourceInstances.record", error=FileNotFoundError)
    path = source.save(tmp_path / "source.npz")
    mapping = InterTaskMapping([0, None, 2], [0, 1])
    refused(method(str(path), mapping), "state must hold indices from 0 to 1", "the source task has 2 variables")
    content = path.read_bytes()
    for part in (content[: len(content) // 2], b"", b"not a source"):
        path.write_bytes(part)
        refused(method(path), "source.npz", "damaged")
    np.savez(path, states=np.zeros((3, 2)))
    refused(method(path), "source.npz", "damaged or not a file of source instances")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("nothing", [[], None, 5, {}], ids=repr)
def test_no_source_at_all_is_refused(method, nothing):
    refused(lambda: method(nothing), "source must be SourceInstances, a path to them, or a list of these", repr(nothing))


def test_an_empty_source_cannot_be_made(source):
    with pytest.raises(ValueError, match="states must hold at least one instance, got none"):
        source._with_rows(np.empty(0, dtype=np.int64), {})


BAD_ARGUMENTS = [
    ("breadth", 0.0),
    ("breadth", -0.1),
    ("breadth", np.nan),
    ("breadth", np.inf),
    ("breadth", "wide"),
    ("breadth", None),
    ("breadth_decay", 0.0),
    ("breadth_decay", 1.1),
    ("relevance_fraction", 0.0),
    ("relevance_fraction", 1.5),
    ("bandwidths", (0.1, 0.1)),
    ("bandwidths", (0.1, 0.0, 1.0)),
    ("bandwidths", (0.1, np.nan, 1.0)),
    ("bandwidths", 0.1),
    ("bandwidths", "auto"),
    ("relevance", np.nan),
    ("relevance", None),
    ("relevance", "no"),
    ("relevance", 1),
    ("transfer_terminals", np.nan),
    ("transfer_terminals", None),
    ("transfer_terminals", 0.0),
]
BAD_ARGUMENTS_OF_COMBREL = [
    ("min_compliance", -0.1),
    ("min_compliance", np.nan),
    ("min_compliance", None),
    ("min_evidence", -0.1),
    ("min_evidence", np.nan),
    ("min_evidence", None),
    ("n_neighbors", 0),
    ("n_neighbors", -1),
    ("n_neighbors", 2.5),
    ("n_neighbors", None),
    ("n_neighbors", True),
    ("measured", "never"),
    ("measured", None),
    ("max_transitions", 0),
    ("max_transitions", 1e3),
]
ALL_BAD_ARGUMENTS = [(method, *bad) for method in METHODS for bad in BAD_ARGUMENTS]
ALL_BAD_ARGUMENTS += [(COMBREL, *bad) for bad in BAD_ARGUMENTS_OF_COMBREL]


@pytest.mark.parametrize(("method", "name", "value"), ALL_BAD_ARGUMENTS)
def test_an_argument_out_of_its_range_is_refused_at_once_by_name_and_value(method, name, value, source):
    with pytest.raises(ValueError, match=f"{name} must be") as error:
        method(source, **{name: value})
    culprits = value if isinstance(value, tuple) else [value]
    assert any(repr(culprit) in str(error.value) for culprit in culprits)


def test_the_dict_form_names_what_is_wrong(source, tmp_path):
    path = str(source.save(tmp_path / "source.npz"))
    refused({"sb3_combrel.COMBRELL": {"source": path}}, "COMBRELL", "does not exist", "sb3_combrel.COMBREL")
    refused({"nowhere.COMBREL": {"source": path}}, "nowhere.COMBREL", "does not exist")
    refused({"COMBREL": {"source": path}, "TIMBREL": {}}, "one entry", "COMBREL", "TIMBREL")
    refused({}, "one entry")
    refused({"sb3_combrel.FittedRMax": {}}, "must be a transfer method")
    refused({"COMBREL": {"source": path, "n_neighbors": 0}}, "n_neighbors must be", "0")
    refused(7, "transfer must be", "7")


def test_what_fits_is_taken_in_every_form(source, tmp_path):
    path = str(source.save(tmp_path / "source.npz"))
    mapping = {"state": [0, None, 1], "action": [0, 1]}
    for transfer in (
        COMBREL(source),
        COMBREL([source, path]),
        {"sb3_combrel.COMBREL": {"source": path, "mappings": [mapping]}},
        {"TIMBREL": {"source": path, "mapping": mapping}},
        {"TIMBREL": {"source": path, "mapping": [mapping, mapping]}},
    ):
        model = FittedRMax(Untouched(), transfer=transfer, resolution=3)
        assert model.policy.transfer is not transfer
