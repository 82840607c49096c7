"""From what a user gives as mappings to the copies of a source, and to how they are chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.mapping_set import FACTORED_SETS, MappingSet
from sb3_combrel.mappings.named_sets import InterTaskMapping, resolve
from sb3_combrel.mappings.state_mappings import copies_of_source, count_copies, with_mirrored
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates, MappingsLike, SourceLike, load_sources, sizes
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.prior_choice import (
    MAX_FACTORED_VARIABLES,
    Choice,
    Chooser,
    choose_factored,
    choose_mapping,
    draw_factored,
    draw_mapping,
)
from sb3_combrel.transfer.prior.source_prior import SourcePrior

# Each copy predicts every transition with each source action.
MAX_COPIES = 2000
# What COMBREL looks through by default, the largest set that is practical; and where neither is.
PRACTICAL_SETS, WITHOUT_COPIES = ("signed_factored", "factored"), "injective"


def is_factored(mappings: Any) -> bool:
    """Whether ``mappings`` is a factored mapping, a dict of its arguments, or the name of a set of them."""
    named = isinstance(mappings, str) and mappings in FACTORED_SETS
    return named or isinstance(mappings, FactoredMapping) or (isinstance(mappings, Mapping) and "copies" in mappings)


def make_prior(
    source: SourceLike,
    mappings: MappingsLike,
    task: TargetTask,
    *,
    breadth: float,
    transfer_terminals: bool,
    given: bool = False,
    drawn: np.random.Generator | None = None,
    max_transitions: int = 0,
) -> SourcePrior:
    """Make the prior of a target task.

    :param breadth: kernel breadth of the source's model, in unit coordinates of the source
    :param given: ``mappings`` is one mapping, or one for each target action, and is used as it is
    :param drawn: one of ``mappings`` is drawn with this generator; None: it is chosen by evidence, from ``max_transitions``
    :raises ValueError: if source or mappings do not fit the target
    """
    sources = load_sources(source)
    choose: Chooser | Choice
    if isinstance(mappings, str) and is_factored(mappings):
        copies = _named_copies(mappings, sources, task, breadth)
        choose = draw_factored(copies, task.n_actions, drawn) if drawn else partial(choose_factored, copies)
    elif given or is_factored(mappings):
        copies, choose = _given(mappings, sources, task, breadth)
    else:
        candidates = Candidates(source, mappings, task)
        copies = copies_of(candidates, breadth)
        # Which state mapping and source action the set has for each target action, see ``best_actions``.
        allowed = np.zeros((len(copies), task.n_actions, copies.most_actions), dtype=np.bool_)
        _, target_action, _, source_action = np.array(candidates.origins).T
        allowed[candidates.arrays.row, target_action, source_action] = True
        choose = draw_mapping(allowed, drawn) if drawn else partial(choose_mapping, copies, allowed=allowed)
    return SourcePrior(
        copies,
        task,
        choose,
        whole=not is_factored(mappings),
        max_transitions=max_transitions,
        transfer_terminals=transfer_terminals,
    )


def practical_set(sources: Sequence[SourceInstances], task: TargetTask) -> str:
    """The name of the largest set that COMBREL looks through by default, with a warning where it is not the usual one."""
    usual = PRACTICAL_SETS[0]
    factored = PRACTICAL_SETS if task.n_variables <= MAX_FACTORED_VARIABLES else ()
    name = next((each for each in factored if _count_copies(each, sources, task) <= MAX_COPIES), WITHOUT_COPIES)
    if name != usual:
        whole = ", and one source action moves all of them" if name == WITHOUT_COPIES else ""
        warn_user(
            f'mappings="{usual}", the default, has {_count_copies(usual, sources, task):,} copies from these source tasks to '
            f'{task.n_variables} state variables, more than the {MAX_COPIES:,} that are practical: "{name}" is taken instead, '
            f"in which variables are not mirrored{whole}. Fewer variables, or mappings of your own, avoid that",
        )
    return name


def _count_copies(name: str, sources: Sequence[SourceInstances], task: TargetTask) -> int:
    signed = name.startswith("signed_")
    return sum(count_copies(source.n_variables, task.n_variables, signed) for source in sources)


def _named_copies(name: str, sources: Sequence[SourceInstances], task: TargetTask, breadth: float) -> Copies:
    """Every copy of every source, or of some of its variables."""
    if task.n_variables > MAX_FACTORED_VARIABLES:
        raise ValueError(
            f'mappings="{name}" is for targets of at most {MAX_FACTORED_VARIABLES} state variables, got {task.n_variables}; '
            "give a FactoredMapping"
        )
    n_copies = _count_copies(name, sources, task)
    if n_copies > MAX_COPIES:
        raise ValueError(
            f'mappings="{name}" has {n_copies:,} copies from these source tasks to {task.n_variables} state variables, '
            f'more than the {MAX_COPIES:,} that are practical; leave mappings out, or give "{WITHOUT_COPIES}", whose mappings '
            "are whole, or a FactoredMapping"
        )
    states = [copies_of_source(source.n_variables, task.n_variables) for source in sources]
    signed = [with_mirrored(state) if name.startswith("signed_") else (state, np.ones_like(state)) for state in states]
    number = np.repeat(np.arange(len(signed)), [len(state) for state, _ in signed])
    state, sign = map(np.concatenate, zip(*signed, strict=True))
    return Copies(sources, number, state, sign, breadth)


def check_one_source(sources: Sequence[SourceInstances]) -> None:
    """A mapping that is given is one to one source; a ValueError if there are more."""
    if len(sources) > 1:
        raise ValueError(
            f"source must be one source for a mapping that is given, got {len(sources)}; COMBREL(sources) finds out which of "
            "them each target action is to be taken for"
        )


def _given(mappings: Any, sources: Sequence[SourceInstances], task: TargetTask, breadth: float) -> tuple[Copies, Choice]:
    """The copies of a factored mapping; or one mapping, or one for each target action, which are a copy each."""
    check_one_source(sources)
    if is_factored(mappings):
        factored = mappings if isinstance(mappings, FactoredMapping) else FactoredMapping(**mappings)
        factored.check(**sizes(sources[0], task))
        used = list(factored.copies)
        of_actions = [used] * task.n_actions
    else:
        each = mapping_of_each_action(resolve(mappings, **sizes(sources[0], task)), task.n_actions)
        used = list(dict.fromkeys(each))
        of_actions = [[mapping] for mapping in each]
    numbers = np.array([[used.index(mapping) for mapping in of_action] for of_action in of_actions], dtype=np.int64)
    actions = np.array([[mapping.action[a] for mapping in of] for a, of in enumerate(of_actions)], dtype=np.int64)
    state, sign = (np.array([getattr(mapping, name) for mapping in used]) for name in ("state_index", "state_sign"))
    return Copies(sources, np.zeros(len(used), dtype=np.int64), state, sign, breadth), Choice(numbers, actions)


def mapping_of_each_action(given: MappingSet, n_actions: int) -> list[InterTaskMapping]:
    """Return the mapping of each target action: the one that is given, or its own; a ValueError if there are others."""
    if len(given) not in (1, n_actions):
        raise ValueError(f"mapping must be one mapping or one for each of the {n_actions} target actions, got {len(given)}")
    return [given[a if len(given) > 1 else 0] for a in range(n_actions)]


def copies_of(candidates: Candidates, breadth: float) -> Copies:
    """Return all state mappings of a set, for each source, in the order of the candidates' mapping table."""
    number = np.repeat(np.arange(len(candidates.sets)), [each.n_state_mappings for each in candidates.sets])
    return Copies(candidates.sources, number, *candidates.table, breadth)
