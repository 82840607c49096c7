"""Seeds: the same run to the last bit."""

import numpy as np
from helpers.walk import same_parameters, small


def test_the_same_seed_gives_the_same_run_to_the_last_bit(make):
    one, other, third = (make(seed=seed).learn(150) for seed in (3, 3, 4))
    assert same_parameters(one, other)
    assert not same_parameters(one, third)


def test_a_seed_set_later_gives_the_same_run(make):
    one, other = make(seed=3), make(seed=4)
    other.set_random_seed(3)
    assert same_parameters(one.learn(100), other.learn(100))


def test_without_a_seed_numpys_own_generator_determines_the_run(make):
    runs = []
    for seed in (1, 1, 2, 3, 4, 5):
        np.random.seed(seed)
        runs.append(make(seed=None))
        runs[-1].env.seed(0)
        runs[-1].learn(80)
    assert same_parameters(runs[0], runs[1])


def test_without_a_seed_runs_differ():
    runs = []
    for seed in (1, 2, 3, 4, 5):
        np.random.seed(seed)
        runs.append(small(seed=None))
        runs[-1].env.seed(0)
        runs[-1].learn(80)
    assert not all(same_parameters(runs[0], other) for other in runs[1:])
