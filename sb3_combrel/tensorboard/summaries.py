"""Records of TensorBoard's event files: several scalars in one, and the settings of a run. This imports TensorBoard."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from tensorboard.compat.proto.summary_pb2 import Summary, SummaryMetadata
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2
from torch.utils.tensorboard.summary import hparams


def scalars_summary(scalars: Mapping[str, float]) -> Summary:
    """
    Make one record of several scalars.

    :param scalars: values by tag
    """
    return Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()])


def settings_summaries(
    settings: Mapping[str, Any], columns: Mapping[str, Any], shown: Collection[str], metrics: Collection[str]
) -> list[Summary]:
    """
    Make the records of the HPARAMS tab.

    :param settings: of this run, plain values by name
    :param columns: of all runs; a value, or None, to tell the type of each
    :param shown: names of the settings that the tab shows until the user chooses, five at most
    :param metrics: tags of the scalars that it shows
    """
    _, start, end = hparams(dict(settings), metric_dict=dict.fromkeys(metrics, 0.0))
    experiment = api_pb2.Experiment(
        hparam_infos=[_column(name, value, name in shown) for name, value in columns.items()],
        metric_infos=[api_pb2.MetricInfo(name=api_pb2.MetricName(tag=tag)) for tag in metrics],
    )
    content = plugin_data_pb2.HParamsPluginData(experiment=experiment, version=metadata.PLUGIN_DATA_VERSION)
    plugin_data = SummaryMetadata.PluginData(plugin_name=metadata.PLUGIN_NAME, content=content.SerializeToString())
    of_experiment = Summary.Value(tag=metadata.EXPERIMENT_TAG, metadata=SummaryMetadata(plugin_data=plugin_data))
    return [Summary(value=[of_experiment]), start, end]


def _column(name: str, value: Any, first: bool) -> api_pb2.HParamInfo:
    column = api_pb2.HParamInfo(name=name, type=_type(value))
    # The tab sorts by this, which says that runs differ in it; TensorBoard before 2.14 does not know it.
    if "differs" in column.DESCRIPTOR.fields_by_name:
        column.differs = first
    return column


def _type(value: Any) -> int:
    if isinstance(value, bool):
        return api_pb2.DATA_TYPE_BOOL
    return api_pb2.DATA_TYPE_FLOAT64 if isinstance(value, int | float) else api_pb2.DATA_TYPE_STRING
