"""What the tests of the paper's experiments share: domains of short episodes, and sources that are not learned."""

from dataclasses import replace

import pytest
from helpers.paper_results import quiet

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import SourceInstances
from sb3_combrel.experiments.paper import methods
from sb3_combrel.experiments.paper.domains import DOMAINS
from sb3_combrel.runs.runner import Backend

#: Enough for COMBREL to select mappings in the second episode, too few to reach a goal.
SHORT = 60
SEEDS = (26000, 26001, 26002)


@pytest.fixture(scope="module")
def short():
    """Both domains with episodes of few steps; random actions in the sources instead of learning them."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("from_fitted_rmax", "from_q_learning"):
            patch.setattr(SourceInstances, name, lambda env_id, *_, **__: SourceInstances.record(None, env_id, 400, 0))
        for name, domain in list(DOMAINS.items()):
            settings = {key: replace(setting, max_episode_steps=SHORT) for key, setting in domain.settings.items()}
            patch.setitem(DOMAINS, name, replace(domain, settings=settings))
        yield DOMAINS


@pytest.fixture(scope="module")
def sources(short, tmp_path_factory):
    """What the methods transfer, by domain and seed."""
    folder = tmp_path_factory.mktemp("sources")
    return {name: methods.prepare_sources(domain, SEEDS, folder, Backend(n_jobs=1), quiet()) for name, domain in short.items()}
