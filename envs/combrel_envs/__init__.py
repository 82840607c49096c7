"""Mountain Car and iCub tasks for dm_control and Gymnasium; importing this registers the Gymnasium environments.

>>> import combrel_envs, gymnasium
>>> env = gymnasium.make("combrel/MountainCar4D-v0")
>>> environment = combrel_envs.load("mountain_car", "climb_4d")
"""

from combrel_envs.gym_env import register_envs
from combrel_envs.rendering import RenderingError
from combrel_envs.suite import load

register_envs()

__all__ = ["RenderingError", "load"]
