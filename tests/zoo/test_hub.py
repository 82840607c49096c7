"""Models and sources go to the Hugging Face hub, here a folder, and come back."""

import re
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")

import gymnasium
import huggingface_hub
import yaml
from helpers.hub import FolderHub
from helpers.walk import same_parameters
from huggingface_hub.errors import LocalEntryNotFoundError
from huggingface_sb3 import load_from_hub, package_to_hub, push_to_hub

import combrel_envs  # noqa: F401 - registers the environments
from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.zoo import commands

PAGE = Path(__file__).resolve().parents[2] / "docs/hub.md"
CAR, BIG_CAR = "combrel/MountainCar2D-v0", "combrel/MountainCar4D-v0"
OF_RL_ZOO = "someone/combrel-combrel-MountainCar4D-v0"
OF_RUN = ("--algo", "combrel", "--env", BIG_CAR)


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


def call(command, *args):
    return commands.main([command, *map(str, args)])


def load(folder="logs"):
    return call("load_from_hub", *OF_RUN, "-f", folder, "-orga", "someone")


def raising(error):
    def refuse(**_):
        raise error

    return refuse


class TestBySB3:
    def test_a_model_comes_back_with_its_source_and_learns_on(self, hub, model):
        model.save("car.zip")
        push_to_hub("someone/car", "car.zip", commit_message="first")
        again = FittedRMax.load(load_from_hub("someone/car", "car.zip"), env=BIG_CAR)
        assert same_parameters(model, again) and len(again.transfer.sources[0]) == 200
        assert again.learn(20, reset_num_timesteps=False).num_timesteps == 80

    @pytest.mark.long
    def test_a_package_has_model_results_and_a_card(self, hub, model):
        env = gymnasium.wrappers.TimeLimit(gymnasium.make(BIG_CAR, render_mode="rgb_array").unwrapped, max_episode_steps=5)
        package_to_hub(model, "car", "FittedRMax", BIG_CAR, env, "someone/package", n_eval_episodes=1, video_length=3)
        folder = hub.folder / "someone/package"
        assert {"car.zip", "results.json", "config.json", "README.md"} <= {path.name for path in folder.iterdir()}
        assert same_parameters(model, FittedRMax.load(folder / "car.zip"))


class TestByRLZoo:
    @pytest.mark.long
    def test_a_run_comes_back_with_a_card_that_says_how_it_is_used_here(self, hub, source):
        source.save("source.npz")
        transfer = {"sb3_combrel.COMBREL": {"source": "source.npz"}}
        entry = {"policy": "FittedRMaxPolicy", "n_timesteps": 100, "transfer": transfer}
        Path("settings.yml").write_text(yaml.dump({BIG_CAR: entry}))
        options = ("--gym-packages", "combrel_envs", "--eval-freq", -1, "--env-kwargs", "max_episode_steps:20")
        assert call("train", *OF_RUN, "--conf-file", "settings.yml", "-f", "logs", *options) == 0
        assert call("push_to_hub", *OF_RUN, "-f", "logs", "-orga", "someone", "--no-render") == 0
        assert load("downloaded") == 0
        name = "combrel-MountainCar4D-v0"
        assert same_parameters(*(FittedRMax.load(f"{each}/combrel/{name}_1/{name}.zip") for each in ("logs", "downloaded")))
        assert call("enjoy", *OF_RUN, "-f", "downloaded", "--no-render", "-n", 20, "--gym-packages", "combrel_envs") == 0

        card = huggingface_hub.ModelCard.load(hub.folder / OF_RL_ZOO / "README.md")
        assert "python -m sb3_combrel.zoo load_from_hub --algo combrel --env combrel/MountainCar4D-v0" in card.text
        assert "rl_zoo3" not in card.text and "ZooFittedRMax" not in card.content
        assert {"sb3_combrel", "stable-baselines3"} <= set(card.data.tags)
        [result] = card.data.eval_results
        assert card.data.model_name == "FittedRMax" and result.dataset_name == BIG_CAR

    def test_what_is_missing_on_the_hub_or_untrusted_gives_a_sentence(self, hub, monkeypatch, capsys):
        assert load() == 1 and capsys.readouterr().err == f"sb3_combrel.zoo: 404: no repository {OF_RL_ZOO}\n"
        (hub.folder / OF_RL_ZOO).mkdir(parents=True)
        assert load() == 1 and "has no file combrel-combrel-MountainCar4D-v0.zip" in capsys.readouterr().err
        for error in (LocalEntryNotFoundError, huggingface_hub.errors.HTTPError):
            monkeypatch.setattr(huggingface_hub, "hf_hub_download", raising(error("no connection")))
            assert load() == 1
            assert re.fullmatch(r"sb3_combrel\.zoo: .*no connection.*\n", capsys.readouterr().err)
        monkeypatch.delenv("TRUST_REMOTE_CODE")
        assert load() == 1 and "TRUST_REMOTE_CODE" in capsys.readouterr().err and not Path("logs").exists()


@pytest.mark.long
def test_the_examples_of_the_page_run(hub):
    for example in re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL):
        short = re.sub(r"((?:total_timesteps=|learn\())5_000", r"\g<1>100", example)
        exec(compile(short, "hub.md", "exec"), {"__name__": "example"})
    files = {path.name for path in (hub.folder / "your-name/combrel-MountainCar4D").iterdir()}
    assert files == {"combrel-MountainCar4D.zip", "source.npz"}
