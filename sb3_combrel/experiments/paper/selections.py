"""Tables 2 and 4: the mappings that COMBREL selected, and whether they depend on state and action (Section 5.1)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from sb3_combrel.comparison.tables import Table, p_text
from sb3_combrel.experiments.paper.runs import Result

#: As many action mappings as the paper's Table 2 has.
N_SHOWN = 9
#: Mappings that were selected less often have no say in a test.
FEWEST = 5
#: Selections of successive steps depend on each other: the tests are also made with one of so many.
THINNED = 25


class Selection(NamedTuple):
    """
    Selections of mappings, at most one for each step and target action, of all runs.

    :param state: raw units, shape (n, n_variables)
    :param action: target action, shape (n,)
    :param mapping: action mapping, as text, shape (n,)
    """

    state: np.ndarray
    action: np.ndarray
    mapping: np.ndarray

    @classmethod
    def of_results(cls, results: Sequence[Result]) -> Selection:
        """Collect the selections of runs that have recorded them; the mapping is the source action where none is whole."""
        rows = [(result.uses[int(row[0])], row[1:]) for result in results for row in result.selections]
        state = np.array([state for _, state in rows], dtype=np.float64) if rows else np.zeros((0, 0))
        return cls(state, np.array([use[0] for use, _ in rows]), np.array([use[3] or use[1] for use, _ in rows]))

    def thinned(self, n: int) -> Selection:
        """
        Return one of ``n`` selections of each action.

        In most steps there is one for every action, so one of ``n`` of them all, in their order, could always be of the same.
        """
        places = [np.flatnonzero(self.action == action) for action in np.unique(self.action)]
        # Not all in the same step.
        kept = [place[k * n // len(places) :: n] for k, place in enumerate(places)]
        chosen = np.sort(np.concatenate(kept)) if kept else np.zeros(0, dtype=np.int64)
        return Selection(*(column[chosen] for column in self))


def action_mapping_table(results: Sequence[Result], target_actions: Sequence[str]) -> Table:
    """
    Make a table of the action mappings used most, in percent of each target action's uses (the paper's Table 2).

    :param results: of runs in which whole mappings were candidates
    :param target_actions: names of the target's actions
    """
    count: Counter[tuple[str, str]] = Counter()
    for result in results:
        for target_action, _, _, action_mapping, n in result.uses:
            count["".join(name[0] for name in action_mapping.split(", ")), target_action] += n
    total = {action: sum(n for (_, a), n in count.items() if a == action) for action in target_actions}
    all_uses = sum(total.values())
    by_mapping: Counter[str] = Counter()
    for (mapping, _), n in count.items():
        by_mapping[mapping] += n
    shown = [mapping for mapping, _ in by_mapping.most_common(N_SHOWN)]
    rows = []
    for mapping in shown:
        shares = [_percent(count[mapping, action], total[action]) for action in target_actions]
        rows.append((mapping, *shares, _percent(by_mapping[mapping], all_uses)))
    others = [total[a] - sum(count[mapping, a] for mapping in shown) for a in target_actions]
    rows.append(
        (
            f"{len(by_mapping) - len(shown)} others",
            *(_percent(n, total[a]) for n, a in zip(others, target_actions, strict=True)),
            _percent(sum(others), all_uses),
        )
    )
    rows.append(("selections", *(f"{total[action]:,}" for action in target_actions), f"{all_uses:,}"))
    title = "Action mappings used most, in percent: the source action (by its first letter) of each target action"
    return Table(title, ("mapping", *target_actions, "all"), rows)


def joint_action_table(results: Sequence[Result], target_actions: Sequence[str]) -> Table:
    """
    Make a table of the source action to which each target action was mapped, in percent of its uses (Table 4, by action).

    :param results: of runs of COMBREL
    :param target_actions: names of the target's actions
    """
    count: Counter[tuple[str, str]] = Counter()
    for result in results:
        for target_action, source_action, _, _, n in result.uses:
            count[source_action, target_action] += n
    total = {action: sum(n for (_, a), n in count.items() if a == action) for action in target_actions}
    sources = sorted({source for source, _ in count})
    rows = [(source, *(_percent(count[source, action], total[action]) for action in target_actions)) for source in sources]
    rows.append(("selections", *(f"{total[action]:,}" for action in target_actions)))
    return Table("Source action to which each target action was mapped, in percent", ("source action", *target_actions), rows)


def state_mapping_table(results: Sequence[Result]) -> Table:
    """Make a table of the state mappings used most, in percent of all uses."""
    count: Counter[str] = Counter()
    for result in results:
        for _, _, state_mapping, _, n in result.uses:
            count[state_mapping] += n
    total = sum(count.values())
    rows = [(name, _percent(n, total)) for name, n in count.most_common(N_SHOWN)]
    return Table(f"State mappings used most, in percent ({len(count)} in all)", ("state mapping", "share"), rows)


def dependence_table(selection: Selection, variables: Sequence[str]) -> Table:
    """
    Test whether the action mapping selected depends on the state (Kruskal & Wallis) and on the target action (chi-square).

    The effect is epsilon squared of the former and Cramer's V of the latter, both from 0, no relation, to 1. Successive steps
    have successive states, so that p-values of all selections are too low; the last columns have one selection in
    :data:`THINNED` of each target action.

    :param selection: selections of all runs
    :param variables: names of the state variables
    """
    thinned = selection.thinned(THINNED)
    rows = []
    for k, name in enumerate(variables):
        whole, part = (_kruskal(each, k) for each in (selection, thinned))
        rows.append((f"{name} (Kruskal & Wallis)", *_cells(whole), *_cells(part)))
    whole, part = (_chi_square(each.action, each.mapping) for each in (selection, thinned))
    rows.append(("target action (chi-square)", *_cells(whole), *_cells(part)))
    header = ("mapping against", "statistic", "effect", "p", "statistic, thinned", "effect, thinned", "p, thinned")
    title = f"Does the mapping depend on it? {len(selection.mapping):,} selections, {len(thinned.mapping):,} thinned"
    return Table(title, header, rows)


class _Test(NamedTuple):
    statistic: float
    effect: float
    p_value: float


_NO_TEST = _Test(np.nan, np.nan, np.nan)


def _kruskal(selection: Selection, variable: int) -> _Test:
    mapping = selection.mapping
    kept = _frequent(mapping)
    if not kept.any():
        return _NO_TEST
    values = selection.state[:, variable]
    groups = [values[kept & (mapping == name)] for name in np.unique(mapping[kept])]
    if len(groups) < 2 or np.ptp(values[kept]) == 0.0:
        return _NO_TEST
    test = stats.kruskal(*groups)
    return _Test(test.statistic, test.statistic / (kept.sum() - 1), test.pvalue)


def _chi_square(action: np.ndarray, mapping: np.ndarray) -> _Test:
    kept = _frequent(mapping)
    table = stats.contingency.crosstab(action[kept], mapping[kept]).count if kept.any() else np.zeros((0, 0))
    if min(table.shape) < 2:
        return _NO_TEST
    test = stats.chi2_contingency(table)
    return _Test(test.statistic, float(stats.contingency.association(table, method="cramer")), test.pvalue)


def _frequent(mapping: np.ndarray) -> np.ndarray:
    """Which selections are of mappings that were selected often enough, bool, shape (n,)."""
    names, place, count = np.unique(mapping, return_inverse=True, return_counts=True)
    return np.zeros(0, dtype=bool) if len(names) == 0 else count[place] >= FEWEST


def _cells(test: _Test) -> tuple[str, str, str]:
    if np.isnan(test.p_value):
        return "-", "-", "-"
    return f"{test.statistic:,.0f}", f"{test.effect:.2f}", p_text(test.p_value)


def _percent(n: int, total: int) -> str:
    return f"{100.0 * n / total:.1f}" if total else "-"
