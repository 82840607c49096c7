"""The sums by which copies of a source are judged, against the equations."""

import numpy as np
from helpers.factored import measured, predicted_by

from sb3_combrel.transfer.equations import prediction_compliances, running_scales


def test_compliances_are_those_of_the_equations():
    _, copies, sums, (states, actions, effects) = measured(2, 40, noise=0.01)
    scales = running_scales(effects)
    for copy in (0, 3, 11, 12, 19):
        has = copies.state[copy] >= 0
        for u in range(3):
            predicted = predicted_by(copies, copy, u, states)[:, has]
            each = prediction_compliances(effects[:, has], predicted, scales[:, has])
            errors = (predicted - effects[:, has]) ** 2
            for a in range(5):
                rows = actions == a
                np.testing.assert_allclose(sums.compliance[copy, a, u], each[rows].sum(), rtol=1e-6)
                np.testing.assert_allclose(sums.error[copy, a, u, has], errors[rows].sum(axis=0), rtol=1e-5)
    for a in range(5):
        stays = [
            prediction_compliances(effects[:, [v]], np.zeros((40, 1)), scales[:, [v]])[actions == a].sum() for v in range(4)
        ]
        np.testing.assert_allclose(sums.stay[a], stays)


def test_with_whole_mappings_compliance_is_over_all_variables_those_unmapped_stay():
    _, copies, sums, (states, actions, effects) = measured(2, 25, noise=0.01, whole=True)
    scales = running_scales(effects)
    predicted = np.nan_to_num(predicted_by(copies, 3, 1, states))
    each = prediction_compliances(effects, predicted, scales)
    np.testing.assert_allclose(sums.compliance[3, :, 1], [each[actions == a].sum() for a in range(5)], rtol=1e-6)


def test_what_is_unexplained_is_compared_with_what_the_target_moves_so_far_within_what_the_source_does():
    _, copies, sums, (states, actions, effects) = measured(2, 40, noise=0.01)
    [source] = copies.sources
    sizes = np.abs(source.scaling.to_unit(source.next_states) - source.scaling.to_unit(source.states))
    low = np.median(sizes, axis=0)
    high = np.max([np.median(sizes[source.actions == u], axis=0) for u in range(3)], axis=0)
    for copy, u in ((0, 0), (3, 2), (11, 1), (12, 1), (19, 0)):
        v = int(np.flatnonzero(copies.state[copy] >= 0)[-1])
        k = copies.state[copy, v]
        predicted = predicted_by(copies, copy, u, states)[:, v]
        expected = np.zeros(5)
        for i, action in enumerate(actions.tolist()):
            seen = [np.abs(effects[: i + 1, v][actions[: i + 1] == a]) for a in range(5)]
            motion = max(each.mean() for each in seen if len(each))
            compared = max(effects[i, v] ** 2, (0.25 * min(max(motion, low[k]), high[k])) ** 2)
            expected[action] += covered(copies, states[[i]], copy, u) * min(
                2.0, (effects[i, v] - predicted[i]) ** 2 / compared
            )
        np.testing.assert_allclose(sums.unexplained[copy, :, u, v], expected, rtol=1e-4, err_msg=str((copy, v, u)))


def covered(copies, state, copy, u):
    """The weight of the source's data at a state, at most 1."""
    uses = copies.uses(np.array([[copy]]), np.array([[u]]))
    return min(1.0, copies.predict(uses, copies.work_space(uses), state, np.array([0]))[3][0])
