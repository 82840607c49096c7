"""Text and settings of the dashboard: the table of mappings, HPARAMS, custom scalars."""

import re
from dataclasses import replace

import pytest
from helpers.dashboard import events, run_folder, walker
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2

from sb3_combrel.tensorboard.mapping_table import escaped, mapping_table
from sb3_combrel.tensorboard.summaries import LAYOUT


def test_the_table_of_mappings_counts_uses(learnt):
    transfer = learnt.transfer
    lines = [
        line.split("|")[1:-1] for line in mapping_table(transfer, ("back", "forth")).splitlines() if line.startswith("| ")
    ]
    header, rows = [cell.strip() for cell in lines[0]], {line[0].strip(): line[1:] for line in lines[2:]}
    assert header == ["source action and state mapping", "back", "forth", "All"]
    counts = dict(transfer.mapping_counts())
    total = sum(counts.values())
    for name, cells in rows.items():
        if " with " not in name:
            continue
        source_action, variables = name.split(" with ")
        uses = [counts.get(f"{target}<-{source_action} with {variables}", 0) for target in header[1:3]]
        assert float(cells[-1]) == pytest.approx(100 * sum(uses) / total, abs=0.051)
    assert [float(cell) for cell in rows["Total"]] == [100.0, 100.0, 100.0]


def test_the_table_of_a_method_that_transferred_nothing_is_a_sentence(transfers):
    assert "No step" in mapping_table(walker(transfer=transfers["COMBREL"]).policy.transfer, ("back", "forth"))


def test_names_with_bars_do_not_break_the_table():
    assert escaped("a|b") == r"a\|b"


def test_settings_are_in_the_hparams_tab(transfers, tmp_path):
    walker(tmp_path, transfers["COMBREL"], max_value=1.5).learn(50)
    content = events(run_folder(tmp_path)).PluginTagToContent("hparams")["_hparams_/session_start_info"]
    settings = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info.hparams
    assert settings["algorithm"].string_value == "FittedRMax + COMBREL" and settings["max_value"].number_value == 1.5
    assert settings["model_breadth"].number_value == 0.15 and settings["transfer.n_neighbors"].number_value == 3
    assert settings["transfer.mappings"].string_value == "injective"


def test_the_page_of_custom_scalars_shows_tags_that_exist(transfers, tmp_path):
    there = set()
    for use in ("instances", "prior"):
        transfer = replace(transfers["COMBREL"], use=use)
        walker(tmp_path / use, transfer).learn(100)
        found = events(run_folder(tmp_path / use))
        there |= set(found.Tags()["scalars"])
    written = layout_pb2.Layout.FromString(found.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0])
    assert [category.title for category in written.category] == list(LAYOUT)
    shown = {tag for category in written.category for chart in category.chart for tag in chart.multiline.tag}
    assert not [tag for tag in shown if not any(re.match(tag, each) for each in there)]
