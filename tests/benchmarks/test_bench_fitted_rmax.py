"""The cost of learning, warm; a round is a whole run (see ``python -m sb3_combrel.experiments.bench`` for a table)."""

import pytest

from sb3_combrel.experiments import bench


@pytest.mark.parametrize("case", bench.CASES, ids=lambda case: case.name)
def test_cost_of_a_step(benchmark, case):
    bench.learn(case, 1, seed=1)  # compiles, or loads what is compiled
    steps, seconds = benchmark.pedantic(bench.learn, args=(case, case.n_episodes), rounds=1)
    benchmark.extra_info["ms_per_step"] = 1000 * seconds / steps
    assert steps > case.n_episodes
