"""Screenshots of TensorBoard with runs of several methods, by a headless Chromium: the pictures of docs/gallery.md."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
import warnings
from collections.abc import Iterator
from pathlib import Path

#: Tabs of TensorBoard: file name, the part of the address after "#", window size.
TABS = {
    "scalars": ("scalars", (1300, 1100)),
    "custom_scalars": ("custom_scalars", (1300, 1150)),
    "images": ("images", (1000, 720)),
    "text": ("text", (1200, 720)),
    "hparams": ("hparams", (1500, 400)),
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SECONDS_TO_START = 60
SECONDS_TO_DRAW = 20


def take_screenshots(logs: Path, output: Path, tabs: tuple[str, ...] = tuple(TABS)) -> list[Path]:
    """Start TensorBoard on a folder of runs, take a PNG of each tab of :data:`TABS`, and stop it."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise FileNotFoundError("no Chromium is installed (Debian and Ubuntu: apt-get install chromium)")
    output.mkdir(parents=True, exist_ok=True)
    with _tensorboard(logs) as address:
        return [_photograph(browser, f"{address}/#{TABS[tab][0]}", output / f"{tab}.png", TABS[tab][1]) for tab in tabs]


@contextlib.contextmanager
def _tensorboard(logs: Path) -> Iterator[str]:
    """Run a server of the logs, for this machine only; its address."""
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    logs = logs.resolve()
    # The name is shown on the page; the folders above it are not needed there.
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", logs.name, "--host", "127.0.0.1", "--port", str(port)]
    server = subprocess.Popen([*command, "--samples_per_plugin", "images=100"], cwd=logs.parent, stderr=subprocess.DEVNULL)
    try:
        address = f"http://127.0.0.1:{port}"
        _wait_for(f"{address}/data/runs", server)
        yield address
    finally:
        server.terminate()
        server.wait()


def _wait_for(url: str, server: subprocess.Popen[bytes]) -> None:
    """Wait until the runs have been read."""
    end = time.monotonic() + SECONDS_TO_START
    while time.monotonic() < end and server.poll() is None:
        with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5) as answer:
            if len(answer.read()) > len("[]\n"):
                return
        time.sleep(0.5)
    raise TimeoutError(f"TensorBoard shows no runs at {url} after {SECONDS_TO_START} seconds")


def _photograph(browser: str, address: str, path: Path, size: tuple[int, int]) -> Path:
    command = [browser, "--headless", "--disable-gpu", "--hide-scrollbars", f"--window-size={size[0]},{size[1]}"]
    # Chromium's sandbox does not work for root, as in a container.
    as_root = hasattr(os, "geteuid") and os.geteuid() == 0
    command += ["--force-device-scale-factor=1.5", *(["--no-sandbox"] if as_root else [])]
    with tempfile.TemporaryDirectory() as profile:
        command += [f"--user-data-dir={profile}", f"--virtual-time-budget={1000 * SECONDS_TO_DRAW}", f"--screenshot={path}"]
        subprocess.run([*command, address], check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, timeout=300)
    return path


def learn_with_each_method(logs: Path, total_timesteps: int) -> None:
    """Learn with each method of the demo for so many steps, and log the runs in one folder."""
    from sb3_combrel import FittedRMax
    from sb3_combrel.experiments.tasks import mountain_car
    from sb3_combrel.runs.job import chosen_on_purpose, make_env
    from sb3_combrel.tensorboard.callback import DashboardCallback

    source = mountain_car.learn_source()
    for method, transfer in mountain_car.methods(source).items():
        env = make_env(mountain_car.TARGET_ID, max_episode_steps=1000)
        with chosen_on_purpose(), warnings.catch_warnings(), contextlib.closing(env):
            model = FittedRMax(env, transfer=transfer, seed=0, tensorboard_log=str(logs), **mountain_car.LEARNER)
            dashboard = DashboardCallback(picture_freq=500, scalar_share=1.0)
            model.learn(total_timesteps, dashboard, log_interval=1, tb_log_name=method.replace(" ", "_"))


def main() -> None:
    """``python -m sb3_combrel.experiments.dashboard [FOLDER] [LOGS]``: screenshots into FOLDER, of LOGS or of new runs."""
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "dashboard")
    if len(sys.argv) > 2:
        files = take_screenshots(Path(sys.argv[2]), output)
    else:
        with tempfile.TemporaryDirectory() as folder:
            logs = Path(folder) / "logs"
            learn_with_each_method(logs, total_timesteps=5000)
            files = take_screenshots(logs, output)
    print("\n".join(map(str, files)))


if __name__ == "__main__":
    main()
