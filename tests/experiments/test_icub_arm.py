"""The iCub's torso as the source of its arm: its instances, and the settings in which the arm is learnt."""

from pathlib import Path

import numpy as np
import pytest

from sb3_combrel import COMBREL
from sb3_combrel.experiments.paper.domains import DOMAINS, PAPER
from sb3_combrel.experiments.tasks import icub_arm
from sb3_combrel.runs.job import make_env

CONFIGURATION = Path(__file__).resolve().parents[2] / "zoo_configs" / "combrel_paper.yml"


@pytest.mark.parametrize("domain", DOMAINS.values(), ids=lambda domain: domain.name)
def test_the_papers_setting_is_that_of_the_zoo(domain):
    learner = dict(pytest.importorskip("yaml").safe_load(CONFIGURATION.read_text())[domain.target_id])
    ((method, arguments),) = learner.pop("transfer").items()
    assert method == "sb3_combrel.COMBREL"
    source = arguments.pop("source")
    assert source["n_instances"] == 1000
    assert learner.pop("policy") == "FittedRMaxPolicy" and learner.pop("n_timesteps") > 0
    # Nothing of the file is left out, and nothing is added.
    setting = domain.settings[PAPER]
    assert dict(setting.learner) == learner
    wanted = COMBREL.paper("MountainCar-v0", setting.mappings, **setting.combrel).arguments()
    assert COMBREL("MountainCar-v0", **arguments).arguments() == wanted


@pytest.mark.parametrize("env_id", [icub_arm.SOURCE_ID, icub_arm.TARGET_ID])
def test_the_cap_is_that_of_the_tasks(env_id):
    with make_env(env_id) as env:
        assert env.spec.max_episode_steps == icub_arm.MAX_EPISODE_STEPS


@pytest.mark.long
def test_the_source_has_hits_and_no_return_exceeds_the_bound():
    source = icub_arm.learn_source(seed=3)
    assert len(source) == icub_arm.N_INSTANCES
    assert source.state_names == ("torso_pitch", "torso_yaw") and source.n_actions == 4
    np.testing.assert_array_equal(np.where(source.terminated, 99.0, -1.0), source.rewards)
    assert source.terminated.any() and source.rewards.max() <= icub_arm.LEARNER["max_value"]
