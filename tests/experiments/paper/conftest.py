"""What the tests of the paper's experiments share: sources that are learned once, and domains of short episodes."""

import json
import shutil
from dataclasses import replace

import pytest
from helpers.paper_results import quiet
from sb3_combrel.experiments.output_folder import SETTINGS_FILE
from sb3_combrel.experiments.source_files import FOLDER

from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, MOUNTAIN_CAR
from sb3_combrel.experiments.paper.sources import prepare_sources

#: Enough for COMBREL to select mappings in the second episode, too few to reach a goal.
SHORT = 60


@pytest.fixture(scope="session")
def sources_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sources")
    for domain in DOMAINS.values():
        prepare_sources(domain, folder, quiet())
    return folder


@pytest.fixture(scope="session")
def sources(sources_folder):
    """What the methods transfer, by domain."""
    return {name: prepare_sources(domain, sources_folder, quiet()) for name, domain in DOMAINS.items()}


@pytest.fixture(scope="session")
def prepare(sources_folder):
    """Make a folder for results in which the sources have been learned."""

    def made(folder):
        shutil.copytree(sources_folder / FOLDER, folder / FOLDER)
        (folder / SETTINGS_FILE).write_text(json.dumps({}))
        return folder

    return made


@pytest.fixture
def output(prepare, tmp_path):
    return prepare(tmp_path / "output")


@pytest.fixture
def full_episodes(monkeypatch):
    """Both domains as they are, whatever other tests of the module do."""
    for domain in (MOUNTAIN_CAR, ICUB):
        monkeypatch.setitem(DOMAINS, domain.name, domain)


@pytest.fixture(scope="module")
def short_episodes():
    """Both domains with episodes of so few steps that runs take a second."""
    before = dict(DOMAINS)
    for name, domain in before.items():
        settings = {key: replace(setting, max_episode_steps=SHORT) for key, setting in domain.settings.items()}
        DOMAINS[name] = replace(domain, settings=settings)
    yield DOMAINS
    DOMAINS.update(before)
