"""What Fitted R-Max costs: time of an environment step, memory, the import, and the compilation on first use.

Run as ``python -m sb3_combrel.experiments.bench``.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple


class Case(NamedTuple):
    """One line of the table: text, environment with arguments, arguments of FittedRMax, episodes, whether with COMBREL."""

    name: str
    env_id: str
    env_kwargs: dict[str, Any]
    kwargs: dict[str, Any]
    n_episodes: int
    transfers: bool = False


def _kernel(breadth: float, resolution: int = 3, min_fraction: float = 0.1) -> dict[str, Any]:
    return dict(degree=0, model_breadth=breadth, resolution=resolution, min_fraction=min_fraction)


_CAR_2D, _CAR_4D, _CAR_6D = (f"combrel/MountainCar{n}D-v0" for n in (2, 4, 6))
_SHORT: dict[str, Any] = dict(max_episode_steps=2000)
CASES = (
    Case("Mountain Car 2D, local linear", _CAR_2D, _SHORT, {}, 50),
    Case("Mountain Car 2D, breadth 1/16, resolution 4", _CAR_2D, dict(start="fixed"), _kernel(1 / 16, 4, 0.01), 50),
    Case("Mountain Car 4D, breadth 0.4, resolution 3", _CAR_4D, {}, _kernel(0.4), 200),
    Case("the same with COMBREL", _CAR_4D, {}, _kernel(0.4), 200, transfers=True),
    Case("Mountain Car 4D, breadth 0.2, resolution 3", _CAR_4D, {}, _kernel(0.2), 60),
    Case("Mountain Car 4D, breadth 0.1, resolution 3", _CAR_4D, _SHORT, _kernel(0.1), 12),
    Case("the same with COMBREL", _CAR_4D, _SHORT, _kernel(0.1), 12, transfers=True),
    Case("Mountain Car 4D, local linear, resolution 3", _CAR_4D, _SHORT, {}, 12),
    Case("the same with COMBREL as prior", _CAR_4D, _SHORT, {}, 12, transfers=True),
    Case("Mountain Car 6D, local linear, resolution 2", _CAR_6D, _SHORT, {}, 8),
)
COMPARED_EPISODES = 200
DQN_STEPS = 2000

_IMPORT = """
import time
import stable_baselines3
start = time.perf_counter()
import sb3_combrel
print(time.perf_counter() - start)
"""

_FIRST_USE = """
import time
from sb3_combrel import COMBREL, FittedRMax, SourceInstances
source = SourceInstances.record(None, "MountainCar-v0", n_instances=200, seed=0)
for transfer, n_steps in ((None, 5), (COMBREL(source), 200)):
    model = FittedRMax("MountainCar-v0", transfer=transfer, seed=0)
    start = time.perf_counter()
    model.learn(n_steps)
    model.predict(model.observation_space.sample(), deterministic=True)
    print(time.perf_counter() - start)
"""


def resident_memory() -> float:
    """Return the resident memory of this process in MiB (Linux; elsewhere the peak so far)."""
    try:
        with open("/proc/self/statm") as statm:
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _printed(code: str, **environment: str) -> list[str]:
    """The words that a fresh process prints."""
    variables = {**os.environ, **environment}
    done = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=True)
    return done.stdout.split()


def import_seconds() -> float:
    """Measure the seconds that the import takes on top of that of Stable-Baselines3, in a fresh process."""
    return float(_printed(_IMPORT)[0])


def first_use_seconds() -> tuple[float, float]:
    """Measure the seconds until first steps and prediction in a fresh process, nothing compiled; without, with transfer."""
    with tempfile.TemporaryDirectory() as empty:
        without, transferring = _printed(_FIRST_USE, NUMBA_CACHE_DIR=empty)
    return float(without), float(transferring)


def learn(case: Case, n_episodes: int, seed: int = 0) -> tuple[int, float]:
    """Learn ``n_episodes`` of a case, and return the environment steps and the seconds of processor time."""
    from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
    from stable_baselines3.common.env_util import make_vec_env

    import combrel_envs  # noqa: F401 - registers the environments
    from sb3_combrel import COMBREL, FittedRMax
    from sb3_combrel.experiments.tasks.mountain_car import learn_source

    env = make_vec_env(case.env_id, seed=seed, env_kwargs=case.env_kwargs)
    transfer = COMBREL(learn_source()) if case.transfers else None
    model = FittedRMax(env, seed=seed, transfer=transfer, **case.kwargs)
    start = time.process_time()
    model.learn(10**7, callback=StopTrainingOnMaxEpisodes(n_episodes), log_interval=None)
    return model.num_timesteps, time.process_time() - start


def dqn_milliseconds(case: Case, n_steps: int = DQN_STEPS) -> float:
    """Measure the milliseconds of processor time that a step of Stable-Baselines3's DQN takes on the environment of a case."""
    from stable_baselines3 import DQN
    from stable_baselines3.common.env_util import make_vec_env

    env = make_vec_env(case.env_id, seed=0, env_kwargs=case.env_kwargs)
    model = DQN("MlpPolicy", env, learning_starts=100, seed=0)
    start = time.process_time()
    model.learn(n_steps, log_interval=None)  # type: ignore[arg-type]
    return 1000.0 * (time.process_time() - start) / n_steps


def measure(number: int, fraction: float = 1.0, seed: int = 0) -> tuple[int, float, float, float]:
    """Measure a case in a new process, all compiled.

    :return: steps, milliseconds a step, MiB beyond the imports, and milliseconds that a step of DQN takes there
    """
    code = (
        "import torch; torch.set_num_threads(1)\n"
        "from sb3_combrel.experiments import bench\n"
        f"case = bench.CASES[{number}]\n"
        "bench.learn(bench.CASES[0], 1, seed=1)\n"
        "bench.learn(case, 1, seed=1)\n"
        "before = bench.resident_memory()\n"
        f"steps, seconds = bench.learn(case, max(1, round({fraction} * case.n_episodes)), {seed})\n"
        "print(steps, 1000 * seconds / steps, bench.resident_memory() - before, bench.dqn_milliseconds(case))"
    )
    steps, milliseconds, memory, of_dqn = _printed(code)[-4:]
    return int(steps), float(milliseconds), float(memory), float(of_dqn)


def compare(n_pairs: int, fraction: float) -> None:
    """Print what COMBREL adds to the mean time of a step with each kernel, in pairs of runs at the same time and seed."""
    for number, case in enumerate(CASES):
        if not case.transfers:
            continue
        numbers, added = (number - 1, number), []
        print(f"{CASES[number - 1].name}, without transfer and with COMBREL, {COMPARED_EPISODES} episodes, ms/step")
        fractions = [fraction * COMPARED_EPISODES / CASES[n].n_episodes for n in numbers]
        with ThreadPoolExecutor(2) as pool:
            for seed in range(n_pairs):
                (_, without, *_), (_, transferring, *_) = pool.map(measure, numbers, fractions, (seed, seed))
                added.append(transferring / without - 1.0)
                print(f"seed {seed:2}: {without:.3f} {transferring:.3f} {added[-1]:+.0%}", flush=True)
        print(f"mean {sum(added) / n_pairs:+.0%}, from {min(added):+.0%} to {max(added):+.0%}")


def main() -> None:
    """Run the command line: print the table; "of DQN": a step over one of Stable-Baselines3's DQN, in the same process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--fraction", "--part", type=float, default=1.0, help="fraction of each case's episodes to run")
    parser.add_argument("--pairs", type=int, default=0, help="instead: what transfer adds to a step, in so many pairs of runs")
    arguments = parser.parse_args()
    fraction = arguments.fraction
    if arguments.pairs > 0:
        compare(arguments.pairs, fraction)
        return
    print(f"{'case':45} {'episodes':>8} {'steps':>7} {'ms/step':>8} {'MiB':>6} {'of DQN':>7}")
    for number, case in enumerate(CASES):
        steps, milliseconds, memory, of_dqn = measure(number, fraction)
        n_episodes = max(1, round(fraction * case.n_episodes))
        figures = f"{steps:7} {milliseconds:8.2f} {memory:6.0f} {milliseconds / of_dqn:7.2f}"
        print(f"{case.name:45} {n_episodes:8} {figures}", flush=True)
    print(f"import, beyond that of Stable-Baselines3: {import_seconds():.2f} s")
    without, transferring = first_use_seconds()
    print(f"first use, nothing compiled: {without:.1f} s, and the first use of COMBREL {transferring:.1f} s more")


if __name__ == "__main__":
    main()
