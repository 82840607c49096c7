"""Arguments and attributes under the names that they had in version 0.1.0."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound

from sb3_combrel import COMBREL, TIMBREL, InterTaskMapping
from sb3_combrel.common.serialisation import KIND
from sb3_combrel.transfer.by_name import SAVED, describe_transfer, make_transfer, restore_transfer
from sb3_combrel.transfer.candidates import Candidate
from sb3_combrel.transfer.methods import mapping_transfer
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

FORMER = [("fading", "breadth_decay", 0.5), ("believe_terminal", "transfer_terminals", False)]
OF_COMBREL = [*FORMER, ("voting_radius", "neighbor_radius", 0.25)]


@pytest.fixture
def source():
    return naive.random_source(np.random.default_rng(0), 30, 2, 2)


@pytest.mark.parametrize(
    ("method", "old", "new", "value"), [(COMBREL, *names) for names in OF_COMBREL] + [(TIMBREL, *names) for names in FORMER]
)
def test_a_former_name_is_accepted_with_a_warning(method, old, new, value, source):
    with pytest.warns(DeprecationWarning, match=f"{old} was renamed to {new}"):
        transfer = method(source, **{old: value})
    assert getattr(transfer, new) == value
    with pytest.warns(DeprecationWarning, match=f"{old} was renamed to {new}"):
        assert getattr(transfer, old) == value
    with pytest.warns(DeprecationWarning, match=f"{old} was renamed to {new}"):
        assert getattr(make_transfer({f"sb3_combrel.{method.__name__}": {"source": source, old: value}}), new) == value
    with pytest.raises(TypeError, match=f"{old} was renamed to {new}: give one of them"):
        method(source, **{old: value, new: value})


def test_present_names_and_unknown_ones_are_treated_as_ever(source, recwarn):
    assert COMBREL(source, breadth_decay=0.5).breadth_decay == 0.5
    with pytest.raises(TypeError, match="fadings"):
        COMBREL(source, fadings=0.5)
    with pytest.raises(AttributeError, match="fadings"):
        getattr(COMBREL(source), "fadings")  # noqa: B009
    assert not [warning for warning in recwarn if issubclass(warning.category, DeprecationWarning)]


@pytest.mark.parametrize("method", [COMBREL, TIMBREL])
def test_a_model_saved_with_former_names_is_restored_without_a_warning(method, source, recwarn):
    described = describe_transfer(method(source, breadth_decay=0.5, transfer_terminals=False))
    former = {"breadth_decay": "fading", "transfer_terminals": "believe_terminal", "neighbor_radius": "voting_radius"}
    arguments = {former.get(name, name): value for name, value in described["arguments"].items()}
    assert "fading" in arguments and "breadth_decay" not in arguments
    restored = restore_transfer({KIND: SAVED, "method": described["method"], "arguments": arguments})
    assert (restored.breadth_decay, restored.transfer_terminals) == (0.5, False)
    assert not [warning for warning in recwarn if issubclass(warning.category, DeprecationWarning)]


def test_a_bound_methods_former_attributes(source):
    method = bound(TIMBREL(source, InterTaskMapping([0, None, 1], [0, 1])), naive.target_task(np.zeros((1, 3)), 2))
    with pytest.warns(DeprecationWarning, match="target was renamed to task"):
        assert method.target is method.task
    with pytest.warns(DeprecationWarning, match="way was renamed to candidate"):
        assert method.way(0) == method.candidate(0) == Candidate(0, "a0", "s0<-s0, s2<-s1")
    with pytest.warns(DeprecationWarning, match="Way was renamed to Candidate"):
        assert mapping_transfer.Way is Candidate
    with pytest.warns(DeprecationWarning, match="VirtualSourceTransfer was renamed to MappingTransfer"):
        assert mapping_transfer.VirtualSourceTransfer is MappingTransfer
