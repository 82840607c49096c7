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
