"""The selector of transfer of samples: all drawn instances, and the compliance of every virtual source task meanwhile."""

from __future__ import annotations

import numpy as np

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.transfer.equations import Bandwidths
from sb3_combrel.transfer.instances.compliance import ComplianceTable
from sb3_combrel.transfer.instances.selectors import PooledSelector, SelectorParts


class TaskComplianceSelector(PooledSelector):
    """Selects all candidates of an action, and adds up the compliance of the target's transitions with each (Eq. 6).

    :param starts: the start bandwidth of each state mapping, shape (n_state_mappings,)
    :param max_transitions: how many are recorded
    """

    needs_transitions = True

    def __init__(self, parts: SelectorParts, bandwidths: Bandwidths, starts: np.ndarray, max_transitions: int):
        super().__init__(parts)
        self.max_transitions = max_transitions
        self._table = ComplianceTable(self.candidates, bandwidths, starts, periodic=self.task.periodic)
        n_rows, n_source_actions = self._table.values.shape
        #: Compliances of transitions added up, by state mapping, target action and source action, of all sources.
        self.sums = np.zeros((n_rows, self.task.n_actions, n_source_actions))

    def takes_transitions(self) -> bool:
        return self.transitions.n < self.max_transitions

    def add_transition(self, i: int) -> None:
        self._table.measure(self.transitions, i)
        self.sums[:, int(self.transitions.actions[i])] += self._table.values

    def task_compliance(self, source: int, mapping: InterTaskMapping) -> float:
        """Return the compliance Lambda_X (Eq. 6) of the virtual source task of a mapping to source number ``source``.

        :return: 0 before the first transition
        :raises ValueError: if the set has no such state mapping
        """
        sets, sources = self.candidates.sets, self.candidates.sources
        mappings = sets[source]
        same = (mappings.state_mappings == mapping.state_index) & (mappings.state_signs == mapping.state_sign)
        rows = np.flatnonzero(same.all(axis=1))
        if len(rows) == 0:
            raise ValueError(f"mapping must have a state mapping of the set of source {source}, got {mapping!r}")
        row = int(rows[0]) + sum(each.n_state_mappings for each in sets[:source])
        actions = np.array(mapping.action) + sum(each.n_actions for each in sources[:source])
        of_actions = self.sums[row, np.arange(len(actions)), actions]
        return float(of_actions.sum() / max(self.transitions.n, 1))

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        for i in range(self.transitions.n):
            self.add_transition(i)
