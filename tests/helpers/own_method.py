"""A transfer method of a user's own, in a few lines."""

import numpy as np

from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer.base import Transfer


class Mine(Transfer):
    """Predicts what the last transition with the same action did."""

    def __init__(self, reward=-1.0):
        self.reward = reward

    def observe(self, state, action, reward, next_state, terminated):
        self.effects = getattr(self, "effects", np.zeros((self.task.n_actions, self.task.n_variables)))
        self.effects[action] = next_state - state

    def transferred(self, states, actions, own_weight):
        found = TransferredInstances.empty(len(actions), self.task.n_variables, 1)
        if hasattr(self, "effects"):
            found.length[:] = own_weight < self.task.exploration_threshold
            found.weight[:], found.reward[:] = self.task.exploration_threshold, self.reward
            found.effect[:, 0] = self.effects[actions]
        return found
