"""RL-Zoo's commands with Fitted R-Max, TIMBREL and COMBREL (needs ``pip install "sb3-combrel[zoo]"``).

``python -m sb3_combrel.zoo train --algo combrel --env combrel/MountainCar4D-v0 --conf-file zoo_configs/combrel.yml``
"""

from sb3_combrel.zoo.registration import ALGORITHMS, register

__all__ = ["ALGORITHMS", "register"]
