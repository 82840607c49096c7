"""Sources of an output folder: learned once, several at a time."""

import io

import numpy as np
import pytest
from helpers.walk import walk_source
from rich.console import Console

from sb3_combrel.runs.runner import Backend, JobError
from sb3_combrel.runs.source_files import SourceJob, load_or_learn, try_sources


def learn(seed):
    if seed == 13:
        raise RuntimeError("no luck")
    return walk_source().subset(5, seed=seed)


def jobs(folder, *seeds):
    return [SourceJob(group="walk", seed=seed, path=folder / f"walk_seed{seed}.npz", learn=learn) for seed in seeds]


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_each_is_learned_with_its_seed_and_kept_though_another_fails(tmp_path, n_jobs):
    backend, said = Backend(n_jobs=n_jobs), io.StringIO()
    console = Console(file=said, width=200)
    with pytest.raises(JobError, match="walk, source, seed 13: RuntimeError: no luck"):
        load_or_learn(jobs(tmp_path, 3, 13, 4), backend, console)
    assert "walk, source, seed 3: 5 steps" in said.getvalue()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["walk_seed3.npz", "walk_seed4.npz"]
    for seed, found in zip((4, 3), load_or_learn(jobs(tmp_path, 4, 3), backend, console), strict=True):
        np.testing.assert_array_equal(found.states, learn(seed).states)


def test_what_is_there_is_not_learned_again_unless_it_is_damaged(tmp_path):
    asked, said = jobs(tmp_path, 3, 4), io.StringIO()
    learn(8).save(asked[0].path)
    asked[1].path.write_bytes(b"damaged")
    console = Console(file=said, width=200)
    kept, again, same = (result.more["instances"] for result in try_sources([*asked, asked[0]], Backend(n_jobs=1), console))
    assert said.getvalue().count("they are learned again") == said.getvalue().count("seed 4: 5 steps") == 1
    assert "seed 3" not in said.getvalue()
    for found, seed in ((kept, 8), (same, 8), (again, 4)):
        np.testing.assert_array_equal(found.states, learn(seed).states)
