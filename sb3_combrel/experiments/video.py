"""A short video of a trained agent."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

FRAMES_A_SECOND = 15


def greedy_episode(model: BaseAlgorithm, env: Any, seed: int | None = None) -> Iterator[tuple[int, bool]]:
    """
    Drive one episode without exploring.

    :param model: the agent
    :param env: the environment; it is left open
    :param seed: seed of the episode
    :return: after each step its number, from 1 on, and whether the episode is over
    """
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
    """
    Film one episode, driven without exploring.

    :param model: the agent
    :param env: an environment with ``render_mode="rgb_array"``; it is left open
    :param path: MP4 file to write
    :param seed: seed of the episode
    :param every: steps between two frames, as software rendering is slow
    :param most_steps: steps after which the film ends if the episode does not
    :raises combrel_envs.RenderingError: if OpenGL is missing
    """
    frames = []
    for step, over in greedy_episode(model, env, seed):
        if over or step % every == 1:
            frames.append(env.render())
        if step >= most_steps:
            break
    write_video(frames, path)


def write_video(frames: list[Any], path: Path, fps: int = FRAMES_A_SECOND) -> None:
    """
    Write frames as an MP4 file, completely or not at all.

    :param frames: arrays of shape (height, width, 3), uint8
    :param path: file to write
    :param fps: frames a second
    """
    from moviepy.video.io.ImageSequenceClip import ImageSequenceClip

    unfinished = path.with_suffix(".part.mp4")
    ImageSequenceClip(frames, fps=fps).write_videofile(str(unfinished), logger=None)
    unfinished.replace(path)
