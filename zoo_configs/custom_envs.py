"""RL-Zoo imports a module of this name when it starts: with it an unmodified RL-Zoo knows the algorithms.

``PYTHONPATH=zoo_configs python -m rl_zoo3.train --algo fitted_rmax --gym-packages combrel_envs ...``
"""

from sb3_combrel.zoo import register

register()
