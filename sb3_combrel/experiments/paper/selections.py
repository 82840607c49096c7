"""Tables 2 and 4: the mappings that COMBREL selected, and whether they depend on state and action (Section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from scipy import stats

from sb3_combrel.comparison.tables import Table, p_text
from sb3_combrel.runs.job import Result

#: As many action mappings as the paper's Table 2 has.
N_SHOWN = 9
#: Mappings that were selected less often have no say in a test.
FEWEST = 5
#: Selections of successive steps depend on each other: the tests are also made with one of so many.
THINNED = 25
ACTION, SOURCE_ACTION, STATES, MAPPING, ALL = "target action", "source action", "state mapping", "mapping", "all"


def action_mapping_table(results: Sequence[Result], target_actions: Sequence[str]) -> Table:
    """Make a table of the action mappings used most, in percent of each target action's uses (the paper's Table 2)."""
    counts = _counts(results, MAPPING, target_actions)
    others = counts[N_SHOWN:].sum().to_frame(f"{len(counts[N_SHOWN:])} others").T
    title = "Action mappings used most, in percent: the source action (by its first letter) of each target action"
    return Table(title, (MAPPING, *target_actions, ALL), _shares(pd.concat([counts[:N_SHOWN], others])))


def joint_action_table(results: Sequence[Result], target_actions: Sequence[str]) -> Table:
    """Make a table of the source action to which each target action was mapped, in percent of its uses (Table 4)."""
    counts = _counts(results, SOURCE_ACTION, target_actions).drop(columns=ALL).sort_index()
    title = "Source action to which each target action was mapped, in percent"
    return Table(title, (SOURCE_ACTION, *target_actions), _shares(counts))


def state_mapping_table(results: Sequence[Result]) -> Table:
    """Make a table of the state mappings used most, in percent of all uses."""
    counts = _counts(results, STATES, ())
    title = f"State mappings used most, in percent ({len(counts)} in all)"
    return Table(title, (STATES, "share"), _shares(counts)[:-1][:N_SHOWN])


def _counts(results: Sequence[Result], kind: str, target_actions: Sequence[str]) -> pd.DataFrame:
    """Uses of each mapping, the most used first, by target action and of all actions."""
    rows = [use for result in results for use in result.more["uses"]]
    uses = pd.DataFrame(rows, columns=[ACTION, SOURCE_ACTION, STATES, MAPPING, "n"])
    # An action mapping as the first letters of its source actions.
    uses[MAPPING] = uses[MAPPING].map(lambda names: "".join(name[:1] for name in names.split(", ")))
    counts = uses.pivot_table("n", kind, ACTION, "sum", fill_value=0).astype(int)
    total = counts.sum(axis=1)
    counts = counts.reindex(columns=list(target_actions), fill_value=0).assign(**{ALL: total})
    # Of equally many the one that comes first.
    return counts.loc[uses[kind].unique()].sort_values(ALL, ascending=False, kind="stable")


def _shares(counts: pd.DataFrame) -> list[tuple[str, ...]]:
    """Rows of counts in percent of their column, and the sums of the columns."""
    totals = counts.sum().astype(int)
    rows = [
        (str(name), *(f"{100.0 * n / total:.1f}" if total else "-" for n, total in zip(row, totals, strict=True)))
        for name, row in zip(counts.index, counts.to_numpy(), strict=True)
    ]
    return [*rows, ("selections", *(f"{total:,}" for total in totals))]


def selections_of(results: Sequence[Result], variables: Sequence[str]) -> pd.DataFrame:
    """Collect recorded selections: state, raw units, target action, and mapping (or source action), as text."""
    rows = []
    for result in results:
        for place, *state in result.more.get("selections", ()):
            target_action, source_action, _, action_mapping, _ = result.more["uses"][int(place)]
            rows.append((*state, target_action, action_mapping or source_action))
    return pd.DataFrame(rows, columns=[*variables, ACTION, MAPPING])


def thin(selections: pd.DataFrame, n: int) -> pd.DataFrame:
    """Return one of ``n`` selections of each action; one of ``n`` of them all could always be of the same action."""
    actions = sorted(set(selections[ACTION]))
    # Not all in the same step.
    kept = [selections[selections[ACTION] == action][k * n // len(actions) :: n] for k, action in enumerate(actions)]
    return pd.concat(kept).sort_index() if kept else selections


def dependence_table(selections: pd.DataFrame) -> Table:
    """Test whether the action mapping selected depends on the state (Kruskal & Wallis) and on the target action (chi-square).

    The effect is epsilon squared of the former and Cramer's V of the latter, both from 0, no relation, to 1. Successive steps
    have successive states, so that p-values of all selections are too low; the last columns have one selection in
    :data:`THINNED` of each target action.
    """
    thinned = thin(selections, THINNED)
    rows = []
    for name in selections.columns.drop(MAPPING):
        test = "chi-square" if name == ACTION else "Kruskal & Wallis"
        rows.append((f"{name} ({test})", *_test(selections, name), *_test(thinned, name)))
    header = ("mapping against", "statistic", "effect", "p", "statistic, thinned", "effect, thinned", "p, thinned")
    title = f"Does the mapping depend on it? {len(selections):,} selections, {len(thinned):,} thinned"
    return Table(title, header, rows)


def _test(selections: pd.DataFrame, name: str) -> tuple[str, str, str]:
    """Statistic, effect and p-value; "-" where there is nothing to test."""
    frequent = selections[MAPPING].map(selections[MAPPING].value_counts()) >= FEWEST
    kept = selections[frequent]
    if kept[MAPPING].nunique() < 2 or kept[name].nunique() < 2:
        return "-", "-", "-"
    if name == ACTION:
        table = pd.crosstab(kept[ACTION], kept[MAPPING]).to_numpy()
        test, effect = stats.chi2_contingency(table), stats.contingency.association(table, method="cramer")
    else:
        test = stats.kruskal(*(values.to_numpy() for _, values in kept.groupby(MAPPING)[name]))
        effect = test.statistic / (len(kept) - 1)
    return f"{test.statistic:,.0f}", f"{effect:.2f}", p_text(test.pvalue)
