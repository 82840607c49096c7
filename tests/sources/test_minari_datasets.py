"""Source instances to Minari datasets and back."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.sources import Corridor, assert_same, some_source

from sb3_combrel import SourceInstances


class TestMinari:
    @pytest.fixture(autouse=True)
    def datasets(self, tmp_path, monkeypatch):
        pytest.importorskip("minari")
        pytest.importorskip("h5py")
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        return Path(tmp_path)

    def test_to_minari_and_back_changes_nothing(self):
        source = replace(SourceInstances.record(None, Corridor(), 60, seed=0).subset(40, seed=0), periodic=(True, False))
        dataset = source.to_minari("combrel/corridor-v0", author="someone")
        assert dataset.total_steps == 40
        assert_same(SourceInstances.from_minari("combrel/corridor-v0"), source)
        assert_same(SourceInstances.from_minari(dataset), source)
        assert SourceInstances.from_minari(dataset).periodic == source.periodic
        assert len(SourceInstances.from_minari(dataset, n_instances=10, seed=0)) == 10

    def test_instances_that_follow_one_another_are_one_episode(self):
        source = SourceInstances.record(lambda state: 0, Corridor(step_size=0.125), 20, seed=0)
        episodes = list(source.to_minari("corridor-v0").iterate_episodes())
        lengths = [len(episode.actions) for episode in episodes]
        assert sum(lengths) == 20 and max(lengths) == 6
        assert all(bool(episode.terminations[-1]) != bool(episode.truncations[-1]) for episode in episodes)

    def test_a_missing_minari_is_named_with_its_remedy(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "minari", None)
        for call in (lambda: SourceInstances.from_minari("x-v0"), lambda: some_source().to_minari("x-v0")):
            with pytest.raises(ImportError, match=r'pip install "sb3-combrel\[minari\]"'):
                call()
