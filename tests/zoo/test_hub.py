"""Models and sources go to the Hugging Face hub, here a folder, and come back."""

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

import gymnasium
import huggingface_hub
import yaml
from helpers.hub import FolderHub
from huggingface_hub.errors import LocalEntryNotFoundError
from huggingface_sb3 import load_from_hub, package_to_hub, push_to_hub

import combrel_envs  # noqa: F401 - registers the environments
from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.zoo import commands

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parents[2]
CAR, BIG_CAR = "combrel/MountainCar2D-v0", "combrel/MountainCar4D-v0"
OF_RL_ZOO = "someone/combrel-combrel-MountainCar4D-v0"


@pytest.fixture
def hub(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_COMBREL_CACHE", str(tmp_path / "cache"))
    return FolderHub(tmp_path / "on the hub", monkeypatch)


@pytest.fixture(scope="module")
def source():
    return SourceInstances.record(None, CAR, n_instances=200, seed=0)


@pytest.fixture(scope="module")
def model(source):
    return FittedRMax(BIG_CAR, transfer=COMBREL(source), seed=0).learn(60)


def same_parameters(one, other):
    first, second = (each.get_parameters()["policy"] for each in (one, other))
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def call(command, *args):
    return commands.main([command, *map(str, args)])


class TestBySB3:
    def test_a_model_comes_back_with_its_source_and_learns_on(self, hub, model):
        model.save("car.zip")
        push_to_hub("someone/car", "car.zip", commit_message="first")
        again = FittedRMax.load(load_from_hub("someone/car", "car.zip"), env=BIG_CAR)
        same_parameters(model, again)
        assert len(again.transfer.sources[0]) == 200
        again.learn(20, reset_num_timesteps=False)
        assert again.num_timesteps == 80

    def test_a_source_comes_back_as_it_was(self, hub, source):
        source.save("source.npz")
        push_to_hub("someone/sources", "source.npz")
        again = SourceInstances.load(huggingface_hub.hf_hub_download("someone/sources", "source.npz"))
        assert again.state_names == source.state_names
        np.testing.assert_array_equal(again.states, source.states)
        np.testing.assert_array_equal(again.next_states, source.next_states)

    def test_a_package_has_model_results_and_a_card(self, hub, model):
        class Short(gymnasium.wrappers.TimeLimit):
            pass

        env = Short(gymnasium.make(BIG_CAR, render_mode="rgb_array").unwrapped, max_episode_steps=5)
        package_to_hub(model, "car", "FittedRMax", BIG_CAR, env, "someone/package", n_eval_episodes=1, video_length=3)
        folder = hub.folder / "someone/package"
        assert {"car.zip", "results.json", "config.json", "README.md"} <= {path.name for path in folder.iterdir()}
        assert huggingface_hub.ModelCard.load(folder / "README.md").data.tags[0] == BIG_CAR
        same_parameters(model, FittedRMax.load(folder / "car.zip"))


class TestByRLZoo:
    @pytest.fixture
    def trained(self, hub, tmp_path, source):
        source.save("source.npz")
        entry = {
            "policy": "FittedRMaxPolicy",
            "n_timesteps": 100,
            "transfer": {"sb3_combrel.COMBREL": {"source": "source.npz"}},
        }
        Path("settings.yml").write_text(yaml.dump({BIG_CAR: entry}))
        arguments = ("--algo", "combrel", "--env", BIG_CAR, "--conf-file", "settings.yml", "--gym-packages", "combrel_envs")
        assert (
            call("train", *arguments, "-f", "logs", "--seed", 1, "--eval-freq", -1, "--env-kwargs", "max_episode_steps:20")
            == 0
        )
        return hub

    def test_a_run_comes_back(self, trained, capsys):
        of_run = ("--algo", "combrel", "--env", BIG_CAR)
        assert call("push_to_hub", *of_run, "-f", "logs", "-orga", "someone", "--no-render") == 0
        assert call("load_from_hub", *of_run, "-f", "downloaded", "-orga", "someone") == 0
        sent, received = (
            FittedRMax.load(f"{folder}/combrel/combrel-MountainCar4D-v0_1/combrel-MountainCar4D-v0.zip")
            for folder in ("logs", "downloaded")
        )
        same_parameters(sent, received)
        assert call("enjoy", *of_run, "-f", "downloaded", "--no-render", "-n", 20, "--gym-packages", "combrel_envs") == 0

    def test_the_card_says_how_it_is_used_here(self, trained):
        assert call("push_to_hub", "--algo", "combrel", "--env", BIG_CAR, "-f", "logs", "-orga", "someone", "--no-render") == 0
        card = huggingface_hub.ModelCard.load(trained.folder / OF_RL_ZOO / "README.md")
        assert "python -m sb3_combrel.zoo load_from_hub --algo combrel --env combrel/MountainCar4D-v0" in card.text
        assert "rl_zoo3" not in card.text and "ZooFittedRMax" not in card.content
        assert {"sb3_combrel", "stable-baselines3"} <= set(card.data.tags)
        [result] = card.data.eval_results
        assert card.data.model_name == "FittedRMax" and result.dataset_name == BIG_CAR

    def test_a_repository_that_does_not_exist_gives_a_sentence(self, hub, capsys):
        assert call("load_from_hub", "--algo", "combrel", "--env", BIG_CAR, "-f", "logs", "-orga", "nobody") == 1
        assert capsys.readouterr().err == "sb3_combrel.zoo: 404: no repository nobody/combrel-combrel-MountainCar4D-v0\n"

    def test_a_model_that_is_missing_gives_a_sentence(self, hub, capsys):
        (hub.folder / OF_RL_ZOO).mkdir(parents=True)
        assert call("load_from_hub", "--algo", "combrel", "--env", BIG_CAR, "-f", "logs", "-orga", "someone") == 1
        assert "has no file combrel-combrel-MountainCar4D-v0.zip" in capsys.readouterr().err

    @pytest.mark.parametrize(
        "broken", [LocalEntryNotFoundError("no connection"), huggingface_hub.errors.HTTPError("no connection")]
    )
    def test_no_network_gives_a_sentence(self, hub, monkeypatch, capsys, broken):
        def no_network(**_):
            raise broken

        monkeypatch.setattr(huggingface_hub, "hf_hub_download", no_network)
        assert call("load_from_hub", "--algo", "combrel", "--env", BIG_CAR, "-f", "logs", "-orga", "someone") == 1
        assert re.fullmatch(r"sb3_combrel\.zoo: .*no connection.*\n", capsys.readouterr().err)

    def test_without_trust_nothing_is_downloaded(self, hub, monkeypatch, capsys):
        monkeypatch.delenv("TRUST_REMOTE_CODE")
        assert call("load_from_hub", "--algo", "combrel", "--env", BIG_CAR, "-f", "logs", "-orga", "someone") == 1
        assert "TRUST_REMOTE_CODE" in capsys.readouterr().err


def test_the_examples_of_the_page_run(hub):
    page = (ROOT / "docs/hub.md").read_text()
    for example in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        short = re.sub(r"((?:total_timesteps=|learn\())5_000", r"\g<1>100", example)
        exec(compile(short, "hub.md", "exec"), {"__name__": "example"})
    assert {path.name for path in (hub.folder / "your-name/combrel-MountainCar4D").iterdir()} == {
        *("combrel-MountainCar4D.zip", "source.npz"),
    }
