"""Pictures of the iCub striking the ball: learn a task by Fitted R-Max, then film what was learnt.

Run as ``python -m sb3_combrel.experiments.icub``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import FittedRMax
from sb3_combrel.experiments.video import greedy_episode, write_video

TASK_IDS = {"torso": "combrel/ICubTorsoStrike-v0", "arm": "combrel/ICubArmStrike-v0"}
#: More episodes than it takes to learn a task.
N_EPISODES = {"torso": 40, "arm": 80}
#: What the return cannot exceed: a hit by the first command returns 99.
MAX_VALUE = 100.0

#: As long as the commands take: the film runs in real time.
FRAMES_A_SECOND = 10
#: How long the film goes on after the hit, in frames.
N_ROLLING = 15


def learn(task: str, n_episodes: int | None = None, seed: int = 0, **kwargs: Any) -> FittedRMax:
    """
    Learn a task with the default settings of Fitted R-Max.

    :param task: ``"torso"`` (the source task) or ``"arm"`` (the target task)
    :param n_episodes: how many episodes; None for as many as it takes
    :param seed: seed of the learner
    :param kwargs: other arguments of FittedRMax
    """
    import combrel_envs  # noqa: F401 - registers the tasks

    model = FittedRMax(TASK_IDS[task], **({"max_value": MAX_VALUE, "seed": seed} | kwargs))
    episodes = N_EPISODES[task] if n_episodes is None else n_episodes
    # Every episode is cut off after 400 steps, so the number of steps never ends the learning first.
    return model.learn(400 * episodes, callback=StopTrainingOnMaxEpisodes(episodes))


def film_strike(model: FittedRMax, env: Any, video: Path, picture: Path) -> int:
    """
    Film one episode, played without exploring, until the ball has rolled away; and picture its last moment.

    :param model: the agent
    :param env: a ball-striking environment with ``render_mode="rgb_array"``; it is left open
    :param video: MP4 file to write
    :param picture: PNG file to write: the robot at the end of the episode, hitting the ball if it does
    :return: number of commands of the episode
    :raises combrel_envs.RenderingError: if OpenGL is missing
    """
    from PIL import Image

    frames = [env.render() for _ in greedy_episode(model, env)]
    Image.fromarray(frames[-1]).save(picture)
    write_video(frames + list(_rolling(env)), video, FRAMES_A_SECOND)
    return len(frames)


def _rolling(env: Any) -> Iterator[Any]:
    """Frames of what happens after the last command, when the episode is over."""
    environment = env.unwrapped.environment
    steps = round(environment.control_timestep() / environment.physics.timestep())
    for _ in range(N_ROLLING):
        environment.physics.step(steps)
        yield env.render()


def write_pictures(task: str, look: str, output: Path, n_episodes: int | None = None, seed: int = 0) -> None:
    """
    Learn a task and write the model, a video and a picture into a folder.

    :param task: ``"torso"`` or ``"arm"``
    :param look: ``"primitives"`` or ``"meshes"``
    :param output: the folder
    :param n_episodes: episodes to learn; None for as many as it takes
    :param seed: seed of the learner
    """
    import gymnasium

    output.mkdir(parents=True, exist_ok=True)
    model = learn(task, n_episodes, seed)
    model.save(output / f"{task}.zip")
    video, picture = output / f"{task}.mp4", output / f"{task}.png"
    with closing(gymnasium.make(TASK_IDS[task], render_mode="rgb_array", look=look)) as env:
        n_commands = film_strike(model, env, video, picture)
    print(f"{task}: learnt for {model.num_timesteps} steps, {n_commands} commands without exploring; {video}, {picture}")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Learn the iCub's ball-striking tasks and film what was learnt.")
    parser.add_argument("--task", choices=[*TASK_IDS, "both"], default="both")
    parser.add_argument("--look", choices=["primitives", "meshes"], default="meshes")
    parser.add_argument("--episodes", type=int, default=None, help="episodes to learn; as many as it takes if not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("icub_output"))
    arguments = parser.parse_args()
    for task in TASK_IDS if arguments.task == "both" else [arguments.task]:
        write_pictures(task, arguments.look, arguments.output, arguments.episodes, arguments.seed)


if __name__ == "__main__":
    main()
