"""What the tests of the paper's experiments share: domains of short episodes, and sources that are not learned."""

from dataclasses import replace

import pytest
from helpers.paper_results import quiet

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import SourceInstances
from sb3_combrel.experiments.paper import methods
from sb3_combrel.experiments.paper.domains import DOMAINS
from sb3_combrel.experiments.tasks import icub_arm, mountain_car

#: Enough for COMBREL to select mappings in the second episode, too few to reach a goal.
SHORT = 60


def recorded_from(env_id):
    """Instead of learning a source: random actions in it."""
    return lambda seed: SourceInstances.record(None, env_id, 400, seed)


@pytest.fixture(scope="module")
def short():
    """Both domains with episodes of few steps and sources of few instances."""
    sources = {"mountain_car": mountain_car.SOURCE_ID, "icub": icub_arm.SOURCE_ID}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "N_TARGET_TRANSITIONS", 150)
        for name, domain in list(DOMAINS.items()):
            settings = {key: replace(setting, max_episode_steps=SHORT) for key, setting in domain.settings.items()}
            changed = replace(domain, settings=settings, learn_source=recorded_from(sources[name]))
            patch.setitem(DOMAINS, name, changed)
        yield DOMAINS


@pytest.fixture(scope="module")
def sources(short, tmp_path_factory):
    """What the methods transfer, by domain."""
    folder = tmp_path_factory.mktemp("sources")
    return {name: methods.prepare_sources(domain, folder, quiet()) for name, domain in short.items()}
