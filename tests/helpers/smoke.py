"""Try an installed sb3_combrel and its extras: `python smoke.py [folder it is in]`, in an empty folder away from the clone."""

import sys
import sysconfig
from importlib import metadata
from pathlib import Path

import gymnasium

import combrel_envs
import sb3_combrel
from sb3_combrel import COMBREL, FittedRMax, SourceInstances


def main(folder):
    for package in (sb3_combrel, combrel_envs):
        assert Path(package.__file__).is_relative_to(folder), f"{package.__file__} is not in {folder}"
    assert metadata.version("sb3-combrel") == sb3_combrel.__version__

    for domain, task in (("mountain_car", "climb_4d"), ("icub", "arm_strike")):
        combrel_envs.load(domain, task).reset()
    car = gymnasium.make("combrel/MountainCar4D-v0", max_episode_steps=20)

    source = SourceInstances.record(None, "combrel/MountainCar2D-v0", n_instances=200, seed=0)
    FittedRMax(car, transfer=COMBREL(source), seed=0).learn(60).save("car")
    again = FittedRMax.load("car", env=car).learn(20, reset_num_timesteps=False)
    assert again.num_timesteps == 80 and "Compliance" in str(again.transfer.report())

    (command,) = metadata.distribution("sb3-combrel").entry_points
    assert command.load()(["explain", "car.zip", "--output", "explained"]) == 0
    assert Path("explained/report.txt").exists()

    from rl_zoo3 import ALGOS

    from sb3_combrel.zoo import ALGORITHMS, register

    register()
    assert set(ALGORITHMS) <= set(ALGOS)
    print(f"sb3_combrel {sb3_combrel.__version__} works, Python {sys.version.split()[0]}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else sysconfig.get_paths()["purelib"]).resolve())
