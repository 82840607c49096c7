"""Transfer methods whose mappings are given by name do what they do by number, also after saving."""

import pytest
from helpers.dashboard import NamedWalk
from helpers.walk import same_parameters, small

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, FittedRMax, InterTaskMapping, SourceInstances

BY_NUMBER = InterTaskMapping((0, 1), (0, 1))
BY_NAME = InterTaskMapping({"place": "place", "height": "height"}, {"back": "back", "forth": "forth"})
AS_DICT = {"state": {"place": "place", "height": "height"}, "action": {"back": "back", "forth": "forth"}}
PAIRS = {
    "TIMBREL": lambda mapping: lambda source: TIMBREL(source, mapping),
    "TIMBREL, factored": lambda mapping: lambda source: TIMBREL(source, FactoredMapping([mapping]), use="prior"),
    "COMBREL": lambda mapping: lambda source: COMBREL(source, [mapping]),
}


@pytest.fixture(scope="module")
def source():
    return SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)


@pytest.mark.parametrize("name", PAIRS)
def test_by_name_and_by_number_are_the_same(name, source, tmp_path):
    ours, theirs = (small(NamedWalk(), transfer=PAIRS[name](mapping)(source)).learn(40) for mapping in (BY_NAME, BY_NUMBER))
    assert same_parameters(ours, theirs)
    ours.save(tmp_path / "model")
    # Names of the target are not needed any more.
    loaded = FittedRMax.load(tmp_path / "model", custom_objects={"_names": {}})
    assert same_parameters(ours, loaded)


@pytest.mark.parametrize("mapping", [AS_DICT, {"copies": [AS_DICT]}], ids=["mapping", "factored mapping"])
def test_a_dict_as_in_a_yaml_file_may_have_names(mapping, source):
    use = "prior" if "copies" in mapping else "instances"
    model = small(NamedWalk(), transfer={"sb3_combrel.TIMBREL": {"source": source, "mapping": mapping, "use": use}})
    assert model.transfer.mapping in (BY_NUMBER, FactoredMapping([BY_NUMBER]))


def test_a_target_without_names_is_named_in_the_error(source):
    with pytest.raises(
        ValueError, match="names of the target's variables, s0, s1, got 'place'; a task that names none has s0"
    ):
        small(transfer=TIMBREL(source, BY_NAME))
    given = small(
        transfer=TIMBREL(source, BY_NAME), policy_kwargs=dict(state_names=["place", "height"], action_names=["back", "forth"])
    )
    assert given.transfer.mapping == BY_NUMBER
