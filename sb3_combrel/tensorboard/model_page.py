"""The page of a model: its sentence, returns, mappings, evidence over time, values and bound, and contradictions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.pages.page import Page, Section, picture
from sb3_combrel.pages.plane import Plane
from sb3_combrel.pages.report_sections import contradictions_table, contradictions_text, mapping_section
from sb3_combrel.pages.snapshot import snapshot_of
from sb3_combrel.tensorboard.pictures import colours_of_mappings, is_prior, source_action_figure, varies_by_state
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.outcome_evidence import RegionErrors
from sb3_combrel.transfer.report import TransferReport

NO_HISTORY = "No history is kept of this method. TensorBoard's dashboard draws one while a model learns (tensorboard_log=...)."


def model_page(model: FittedRMax, report: TransferReport, planes: Sequence[Plane]) -> Page:
    """Make the page of a model.

    :param model: that has learned
    :param report: of its transfer method
    :param planes: over which values are drawn
    """
    task, n_steps = model.agent.task, model.agent.model.n_instances
    facts = [
        *_of_transfer(model.transfer, report),
        f"{model.num_timesteps:,} environment steps, {model._episode_num:,} episodes, {n_steps:,} instances kept",
        f"state variables: {', '.join(task.state_names)}; actions: {', '.join(task.action_names)}",
    ]
    colours = colours_of_mappings(model.transfer)
    sections = [_returns(model)]
    if model.transfer is not None:
        sections += [mapping_section({"": [report]}, colours), _evidence(model, report)]
    sections.append(_values(model, planes))
    if varies_by_state(model.transfer):
        sections.append(_source_actions(model, planes))
    if model.transfer is not None:
        sections.append(_contradictions(model.transfer, report))
    what = "without transfer" if model.transfer is None else f"with {type(model.transfer).__name__}"
    return Page(f"What a model learned {what}", [report.sentence], facts, sections)


def _of_transfer(transfer: Transfer | None, report: TransferReport) -> list[str]:
    """The method and its sources, each on a line."""
    if not report.sources:
        return [] if transfer is None else [report.method]
    return [f"{type(transfer).__name__} with use={report.use!r}, from {'; '.join(report.sources)}"]


def _returns(model: FittedRMax) -> Section:
    from sb3_combrel.pages.drawings import returns_figure

    title = "Learning curve"
    episodes = list(model.ep_info_buffer or ())
    if not episodes:
        return Section(title, ["No episode has ended."])
    lengths = np.array([info["l"] for info in episodes], dtype=np.float64)
    returns = np.array([info["r"] for info in episodes], dtype=np.float64)
    is_all = len(episodes) >= model._episode_num
    # Of several environments it is not kept when which one's episode ended: they are counted instead of their steps.
    unit, each, total = "environment steps", lengths, model.num_timesteps
    if model.n_envs > 1:
        unit, each, total = "episodes", np.ones_like(lengths), model._episode_num
    # What came before, if the buffer does not hold all episodes; steps after the last end are not counted.
    ends = (0.0 if is_all else max(0.0, total - each.sum())) + np.cumsum(each)
    shown = f"All {len(episodes)} episodes." if is_all else f"The last {len(episodes)} episodes: the model keeps no more."
    text = f"{shown} The mean return of the last {min(10, len(returns))} is {returns[-10:].mean():.4g}."
    draw = partial(returns_figure, ends, returns, unit)
    return Section(title, [text], [picture(draw, f"Return of each episode over {unit}")])


def _evidence(model: FittedRMax, report: TransferReport) -> Section:
    from sb3_combrel.pages.evidence_drawings import evidence_figure

    title = "Evidence over time"
    if not report.history:
        return Section(title, [NO_HISTORY])
    draw = partial(evidence_figure, report.history, model.agent.task.action_names, colours_of_mappings(model.transfer))
    text = "Renewed ever more rarely; between two renewals nothing changes. A source that is borne out counts for more."
    return Section(title, [text], [picture(draw, "Mapping in use, strength and prediction error over environment steps")])


def _values(model: FittedRMax, planes: Sequence[Plane]) -> Section:
    from sb3_combrel.pages.drawings import value_figure

    snapshot = snapshot_of(model.agent, planes)
    title, text = "Values and policy", []
    if snapshot.bound is not None:
        title = "Values, bound and policy"
        text = ["No state is worth more than the source's values allow, beside which V is drawn."]
    elif is_prior(model.transfer):
        text = ["The source bounds no values, as it does not explain all actions and rewards."]
    words = [" and ".join(name for name in plane.names if name) for plane in planes]
    shown = [
        picture(partial(value_figure, snapshot, plane), f"Value function and greedy action over {over}")
        for plane, over in zip(planes, words, strict=True)
    ]
    return Section(title, text, shown)


def _source_actions(model: FittedRMax, planes: Sequence[Plane]) -> Section:
    draw = [partial(source_action_figure, model.agent, model.transfer, plane) for plane in planes]
    return Section(
        "Source action by state", pictures=[picture(each, "Source action of each target action over a plane") for each in draw]
    )


def _contradictions(transfer: Transfer, report: TransferReport) -> Section:
    from sb3_combrel.pages.drawings import contradictions_figure

    title, text, table = "Where the source was contradicted", [contradictions_text(report)], contradictions_table({"": report})
    errors = errors_of(transfer)
    if errors is None or not report.n_compared:
        return Section(title, text)
    if np.isnan(errors.by_part()).all():
        return Section(title, [*text, "In no part of the state space are there enough of them to say where."])
    task = errors.task
    draw = partial(contradictions_figure, errors.by_part(), task.action_names, errors.edges())
    text.append(
        'Prediction error over that of "no change", by target action and part of each variable\'s range; grey: unknown.'
    )
    words = "Prediction error by target action and part of each variable's range"
    return Section(title, text, [picture(draw, words)], table)


def errors_of(transfer: Transfer) -> RegionErrors | None:
    """Return where a method was right and wrong; None if it does not count it."""
    return transfer.region_errors if isinstance(transfer, MappingTransfer) else None
