"""Compliance: how probable target transitions are under the source task, seen through mappings (Eqs. 1-6).

For a transition with target action a, compliance depends on the state mapping and on the one source action that a
maps to. A table [state mapping, source action] for each transition therefore holds the compliance of every pair of a
state and an action mapping, however many there are. And since the kernel exp(-d^2 / delta) of a Euclidean distance is
a product of one factor a variable, the exponentials needed are one for each pair of a target and a source variable,
whatever the number of state mappings.
"""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled


class Bandwidths(NamedTuple):
    """Bandwidths delta of phi(x) = exp(-x^2 / delta), in unit coordinates (reward: raw).

    :param start: of the distance between the states where two transitions start (delta_sa)
    :param outcome: of the distance between outcomes (delta_s')
    :param reward: of the difference of rewards (delta_r)
    """

    start: float
    outcome: float
    reward: float


class MappingTable(NamedTuple):
    """State mappings for compiled code, one a row.

    :param index: int64, shape (n_state_mappings, n_target_variables): source variable of each target variable, -1 for none
    :param sign: float64, same shape: -1 where the variable is mirrored
    """

    index: np.ndarray
    sign: np.ndarray


class ComplianceScratch(NamedTuple):
    """Work space: kernel factors of one source instance, by target variable, source variable and (not) mirrored.

    :param start: float64, shape (n_target_variables, n_source_variables, 2)
    :param outcome: the same for outcomes
    :param still: float64, shape (n_target_variables,): outcome factor of a variable that is predicted not to change
    :param sums: float64, shape (n_state_mappings, 3): sums over instances of weight, weight x outcome, weight x reward
    """

    start: np.ndarray
    outcome: np.ndarray
    still: np.ndarray
    sums: np.ndarray

    @classmethod
    def empty(cls, n_target_variables: int, n_source_variables: int, n_state_mappings: int) -> "ComplianceScratch":
        """Work space for tables of this size."""
        pairs = (n_target_variables, n_source_variables, 2)
        return cls(np.empty(pairs), np.empty(pairs), np.empty(n_target_variables), np.empty((n_state_mappings, 3)))


# Below this sum of kernel weights (a tenth of one instance at a distance of sqrt(2.3 delta)) nothing is near enough to
# say anything: normalized, a far instance would look as good as a near one.
LEAST_EVIDENCE = 0.1


@compiled
def _kernel_factors(state, effect, source, action, j, mirrored, bandwidths, scratch):
    """Fill ``scratch.start`` and ``scratch.outcome`` for source instance ``j`` of ``action``."""
    for v in range(len(state)):
        for k in range(source.state.shape[2]):
            here = source.state[action, j, k]
            moved = source.effect[action, j, k]
            apart = state[v] - here
            missed = effect[v] - moved
            scratch.start[v, k, 0] = np.exp(-apart * apart / bandwidths.start)
            scratch.outcome[v, k, 0] = np.exp(-missed * missed / bandwidths.outcome)
            if mirrored:
                apart = state[v] - (1.0 - here)
                missed = effect[v] + moved
                scratch.start[v, k, 1] = np.exp(-apart * apart / bandwidths.start)
                scratch.outcome[v, k, 1] = np.exp(-missed * missed / bandwidths.outcome)


@compiled
def transition_compliance(state, effect, reward, source, mappings, mirrored, bandwidths, scratch, table):
    """Compliance of one target transition with the source through every state mapping, for every source action (Eq. 5).

    The transition function's part is the mean of phi(d(s', s + (s_j' - s_j))) weighted by w_ij (Eq. 2), the reward
    function's the mean of phi(|r - r_j|), both over the source instances of one action. Z^P and Z^R are left out: they
    are the same for all mappings, and would hide what is to be compared if they were not. An unmapped variable adds
    nothing to where a transition starts, and is predicted not to change.

    :param state: unit coordinates of the target, shape (n_target_variables,)
    :param effect: next state minus state, same shape
    :param source: InstanceArrays of the source, in its own unit coordinates
    :param mirrored: whether any sign is -1
    :param table: receives the compliances, shape (n_state_mappings, n_source_actions); 0 where no instance is near
    """
    n_mappings, n_variables = mappings.index.shape
    for v in range(n_variables):
        scratch.still[v] = np.exp(-effect[v] * effect[v] / bandwidths.outcome)
    for action in range(len(source.count)):
        scratch.sums[:, :] = 0.0
        for j in range(source.count[action]):
            _kernel_factors(state, effect, source, action, j, mirrored, bandwidths, scratch)
            off = reward - source.reward[action, j]
            same_reward = np.exp(-off * off / bandwidths.reward)
            for m in range(n_mappings):
                weight = 1.0
                outcome = 1.0
                for v in range(n_variables):
                    k = mappings.index[m, v]
                    if k < 0:
                        outcome *= scratch.still[v]
                    else:
                        mirror = 1 if mappings.sign[m, v] < 0.0 else 0
                        weight *= scratch.start[v, k, mirror]
                        outcome *= scratch.outcome[v, k, mirror]
                scratch.sums[m, 0] += weight
                scratch.sums[m, 1] += weight * outcome
                scratch.sums[m, 2] += weight * same_reward
        for m in range(n_mappings):
            total = scratch.sums[m, 0]
            if total < LEAST_EVIDENCE:
                table[m, action] = 0.0
            else:
                table[m, action] = (scratch.sums[m, 1] / total) * (scratch.sums[m, 2] / total)


@compiled
def compliance_table(states, effects, rewards, source, mappings, mirrored, bandwidths, scratch, tables):
    """:func:`transition_compliance` of many transitions; ``tables`` has one table a transition."""
    for i in range(len(rewards)):
        transition_compliance(
            states[i], effects[i], rewards[i], source, mappings, mirrored, bandwidths, scratch, tables[i]
        )


def task_compliance(tables: np.ndarray, actions: np.ndarray, state_index: int, action_mapping: np.ndarray) -> float:
    """Compliance of the whole target sample with one virtual source task (Eq. 6, all mappings equally likely).

    :param tables: shape (n_transitions, n_state_mappings, n_source_actions)
    :param actions: target action of each transition, shape (n_transitions,)
    :param action_mapping: source action of each target action, shape (n_target_actions,)
    """
    return float(tables[np.arange(len(actions)), state_index, np.asarray(action_mapping)[actions]].mean())


def default_bandwidths(source: "InstanceArrays") -> Bandwidths:  # type: ignore[name-defined]  # noqa: F821
    """Bandwidths that suit a source, whatever the task.

    The start bandwidth is the squared distance to about the 20th instance of the same action (their median): that many
    share in the prediction. The outcome bandwidth is the mean squared effect: an outcome missed by as much as things
    usually move counts as 1/e. The reward bandwidth is the rewards' variance; 1 where they are all alike.
    """
    from scipy.spatial import cKDTree

    distances, effects, rewards = [], [], []
    for action, n in enumerate(source.count):
        if n > 1:
            states = source.state[action, :n]
            nth = min(20, n - 1) + 1
            distances.append(cKDTree(states).query(states, k=[nth])[0].ravel())
        effects.append((source.effect[action, :n] ** 2).sum(axis=1))
        rewards.append(source.reward[action, :n])
    start = float(np.median(np.concatenate(distances))) ** 2 if distances else 0.02
    variance = float(np.concatenate(rewards).var())
    return Bandwidths(
        start=max(start, 1e-6),
        outcome=max(float(np.concatenate(effects).mean()), 1e-9),
        reward=variance if variance > 1e-12 else 1.0,
    )
