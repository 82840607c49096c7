"""The page of TensorBoard's Custom Scalars tab on which runs of several methods are compared."""

from __future__ import annotations


def _chart(*tags: str) -> list[object]:
    return ["Multiline", [f"^{tag}$" for tag in tags]]


# Every chart of the first page has one curve for each run, so that runs of different methods can be compared.
LAYOUT: dict[str, dict[str, list[object]]] = {
    "Learning": {
        "return of an episode": _chart("rollout/ep_rew_mean"),
        "steps of an episode": _chart("rollout/ep_len_mean"),
        "pairs known from own data (share)": _chart("model/known"),
        "pairs modelled by transfer (share)": _chart("model/transferred"),
        "pairs still optimistic (share)": _chart("model/optimistic"),
        "steps per second": _chart("time/fps"),
    },
    "Transfer": {
        "mean compliance of the chosen mappings": _chart("transfer/compliance"),
        "entropy of the choice (nats)": _chart("transfer/choice_entropy"),
        "mappings in use": _chart("transfer/distinct_mappings"),
        "switches of the choice": _chart("transfer/switches"),
        "transferred instances used": _chart("transfer/instances_used"),
    },
    "Planner": {
        "Bellman residual": _chart("planner/residual"),
        "backups": _chart("planner/backups"),
        "share of the time": _chart("planner/time_share"),
    },
}
