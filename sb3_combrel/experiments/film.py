"""Short films of trained agents; of the iCub striking the ball by ``python -m sb3_combrel.experiments.film``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import FittedRMax

FRAMES_A_SECOND = 15

TASK_IDS = {"torso": "combrel/ICubTorsoStrike-v0", "arm": "combrel/ICubArmStrike-v0"}
#: More episodes than it takes to learn a task.
N_EPISODES = {"torso": 40, "arm": 80}
#: What the return cannot exceed: a hit by the first command returns 99.
MAX_VALUE = 100.0

#: As long as the commands take: the iCub's film runs in real time.
ICUB_FRAMES_A_SECOND = 10
#: How long the film goes on after the hit, in frames.
N_ROLLING = 15


def greedy_episode(model: BaseAlgorithm, env: Any, seed: int | None = None) -> Iterator[tuple[int, bool]]:
    """Drive one episode without exploring; after each step its number, from 1 on, and whether the episode is over."""
    observation, _ = env.reset(seed=seed)
    step, over, state = 0, False, None
    while not over:
        action, state = model.predict(observation, state, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        step, over = step + 1, terminated or truncated
        yield step, over


def film(
    model: BaseAlgorithm, env: Any, path: Path, seed: int | None = None, *, every: int = 4, most_steps: int = 400
) -> None:
    """Film one episode of an "rgb_array" environment, a frame ``every`` so many steps, driven without exploring."""
    frames = []
    for step, over in greedy_episode(model, env, seed):
        if over or step % every == 1:
            frames.append(env.render())
        if step >= most_steps:
            break
    write_video(frames, path)


def write_video(frames: list[Any], path: Path, fps: int = FRAMES_A_SECOND) -> None:
    """Write frames of shape (height, width, 3), uint8, as an MP4 file, completely or not at all."""
    from moviepy.video.io.ImageSequenceClip import ImageSequenceClip

    unfinished = path.with_suffix(".part.mp4")
    ImageSequenceClip(frames, fps=fps).write_videofile(str(unfinished), logger=None)
    unfinished.replace(path)


def learn(task: str, n_episodes: int | None = None, seed: int = 0, **kwargs: Any) -> FittedRMax:
    """Learn a task, "torso" or "arm", with Fitted R-Max's default settings; as many episodes as it takes if None."""
    import combrel_envs  # noqa: F401 - registers the tasks

    model = FittedRMax(TASK_IDS[task], **({"max_value": MAX_VALUE, "seed": seed} | kwargs))
    episodes = N_EPISODES[task] if n_episodes is None else n_episodes
    # Every episode is cut off after 400 steps, so the number of steps never ends the learning first.
    return model.learn(400 * episodes, callback=StopTrainingOnMaxEpisodes(episodes))


def film_strike(model: FittedRMax, env: Any, video: Path, picture: Path) -> int:
    """Film an episode, played without exploring, until the ball has rolled away; picture its end; return its length."""
    from PIL import Image

    frames = [env.render() for _ in greedy_episode(model, env)]
    Image.fromarray(frames[-1]).save(picture)
    write_video(frames + list(_rolling(env)), video, ICUB_FRAMES_A_SECOND)
    return len(frames)


def _rolling(env: Any) -> Iterator[Any]:
    """Frames of what happens after the last command, when the episode is over."""
    environment = env.unwrapped.environment
    steps = round(environment.control_timestep() / environment.physics.timestep())
    for _ in range(N_ROLLING):
        environment.physics.step(steps)
        yield env.render()


def write_pictures(task: str, look: str, output: Path, n_episodes: int | None = None, seed: int = 0) -> None:
    """Learn a task and write the model, a video and a picture into a folder; see :func:`icub`."""
    output.mkdir(parents=True, exist_ok=True)
    model = learn(task, n_episodes, seed)
    model.save(output / f"{task}.zip")
    video, picture = output / f"{task}.mp4", output / f"{task}.png"
    with closing(gym.make(TASK_IDS[task], render_mode="rgb_array", look=look)) as env:
        n_commands = film_strike(model, env, video, picture)
    print(f"{task}: learnt for {model.num_timesteps} steps, {n_commands} commands without exploring; {video}, {picture}")


def icub(
    task: Literal["torso", "arm", "both"] = "both",
    look: Literal["primitives", "meshes"] = "meshes",
    episodes: int | None = None,
    seed: int = 0,
    output: Path = Path("icub_output"),
) -> None:
    """Learn the iCub's ball-striking tasks and film what was learnt.

    :param task: which
    :param look: of the robot
    :param episodes: to learn; as many as it takes by default
    :param seed: seed of the learner
    :param output: folder for models, videos and pictures
    """
    for name in TASK_IDS if task == "both" else [task]:
        write_pictures(name, look, output, episodes, seed)


if __name__ == "__main__":
    import tyro

    tyro.cli(icub)
