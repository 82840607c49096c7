"""The history of a prior's evidence: what was believed at each time, also after saving, in few points."""

import numpy as np
import pytest
from helpers.dashboard import NamedWalk, walker
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import COMBREL, FittedRMax, SourceInstances


class Believed(BaseCallback):
    """Keeps at every step what is believed of the source."""

    def __init__(self):
        super().__init__()
        self.seen, self.ended = {}, set()

    def _on_step(self):
        if self.locals["dones"].any():
            self.ended.add(self.num_timesteps)
        prior = self.model.transfer.source_prior
        strengths = np.exp(np.log(prior.evidence.strength).mean(axis=1))
        numbers = [prior.candidates.describe_moves(prior.choice.moves(a)) if prior.choice else "nothing" for a in range(2)]
        self.seen[self.num_timesteps] = strengths.tolist(), numbers, prior.excess
        return True


@pytest.fixture(scope="module")
def learnt():
    source = SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)
    believed = Believed()
    return walker(transfer=COMBREL(source, use="prior")).learn(300, believed), believed


def test_between_two_points_nothing_changes(learnt):
    model, believed = learnt
    history = model.transfer.report().history
    steps = [point.step for point in history]
    assert steps[0] == 10 and steps[-1] == 300 and len(steps) < 20 and (np.diff(steps) > 0).all()
    for step, (strengths, mappings, excess) in believed.seen.items():
        if step >= steps[0] and step not in believed.ended:  # what an episode's end changes was seen before it
            point = history[np.searchsorted(steps, step, side="right") - 1]
            assert point.strengths == pytest.approx(strengths) and list(point.mappings) == mappings
            assert point.exceeded == excess


def test_the_last_point_is_of_now(learnt):
    model, _ = learnt
    report, prior = model.transfer.report(), model.transfer.source_prior
    last = report.history[-1]
    assert last.error == prior.error() and last.exceeded == prior.excess
    assert last.bounds_values == report.bounds_values and last.step == report.n_steps
    assert [each.mapping for each in report.mappings] == list(last.mappings)
    assert [each.strength for each in report.mappings] == pytest.approx(last.strengths)


def test_it_is_saved_with_the_model_and_goes_on(learnt, tmp_path):
    model, _ = learnt
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=NamedWalk())
    before = model.transfer.report().history
    np.testing.assert_equal(loaded.transfer.report().history, before)
    assert loaded.transfer.source_prior.bounding.same(model.transfer.source_prior.bounding)
    loaded.learn(200, reset_num_timesteps=False)
    after = loaded.transfer.report().history
    # The last point is of the present, until something changes.
    np.testing.assert_equal(after[: len(before) - 1], before[:-1])
    assert 300 < after[len(before)].step <= after[-1].step == 500
