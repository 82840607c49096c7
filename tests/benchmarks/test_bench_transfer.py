"""Transfer of 1000 instances of Mountain Car to 4D: compliance of 3000 transitions, and translation for 3000 states."""

import time

import numpy as np
import pytest
from helpers.naive_transfer import target_task

from sb3_combrel import TIMBREL, MappingSet, SourceInstances
from sb3_combrel.transfer.candidates import stacked_instances, stacked_table
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths
from sb3_combrel.transfer.instances.compliance import ComplianceScratch, transition_compliance

N_TRANSITIONS = 3000
SETS = {"injective (12 x 243)": (MappingSet.injective, 12), "all (50 x 243)": (MappingSet.all, 50)}


def source_of_random_walks():
    return SourceInstances.record(None, "combrel/MountainCar2D-v0", n_instances=1000, seed=0)


# Seconds of this process: the machine may be busy with other things. The best round counts, for the same reason.
@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("name", SETS)
def test_compliance_of_3000_transitions_with_every_mapping(benchmark, name):
    make_set, n_state_mappings = SETS[name]
    mappings = make_set(2, 4, 3, 5)
    assert (mappings.n_state_mappings, mappings.n_action_mappings) == (n_state_mappings, 243)
    instances, table = stacked_instances([source_of_random_walks()]), stacked_table([mappings])
    rng = np.random.default_rng(0)
    states, bandwidths = rng.uniform(0.3, 0.7, (N_TRANSITIONS, 4)), default_bandwidths(instances)
    effects, found = 0.02 * rng.normal(size=states.shape), np.empty((len(table.variable), len(instances.size)))
    scratch = ComplianceScratch.for_mappings(table, instances, bandwidths.start)
    given = tuple(instances), tuple(table), tuple(bandwidths), tuple(scratch), found

    def all_transitions():
        for state, effect in zip(states, effects, strict=True):
            transition_compliance(state, effect, -1.0, *given)

    benchmark.pedantic(all_transitions, rounds=5, warmup_rounds=1)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("relevance", [False, True], ids=["nearest first", "most relevant first"])
def test_translation_of_3000_states_from_the_pool_of_all_mappings(benchmark, relevance):
    states = np.random.default_rng(0).uniform(0.3, 0.7, (N_TRANSITIONS, 4))
    method = TIMBREL(source_of_random_walks(), "pool", mappings="injective", breadth=0.1, relevance=relevance)
    method.bind(target_task(states, 5), np.random.default_rng(0))
    points, actions, own = np.arange(N_TRANSITIONS), np.zeros(N_TRANSITIONS, dtype=np.int64), np.zeros(N_TRANSITIONS)
    found = benchmark.pedantic(method.transferred_to_sample, args=(points, actions, own), rounds=5, warmup_rounds=1)
    assert found.length[:N_TRANSITIONS].any()
