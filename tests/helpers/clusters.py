"""Small clusters of Ray and Dask on this machine: a head and two workers, each a process of its own."""

import os
import random
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil

HOST = "127.0.0.1"
SECONDS_TO_START = 120


@contextmanager
def ray_cluster(n_workers=2):
    """A head without CPUs, and worker nodes with one CPU each.

    :return: address of the head
    """
    from ray.util import get_node_ip_address

    # Workers look for the head at this machine's address in the network, if it has one, even where they are told HOST.
    port, host = free_port(), get_node_ip_address()
    common = ("--block", "--node-ip-address", host, "--object-store-memory", "100000000")
    head = ("--head", "--port", port, "--ray-client-server-port", free_port(), "--num-cpus", 0)
    quiet = ("--include-dashboard", "false", "--disable-usage-stats")
    with ExitStack() as stack:
        # Not pytest's folder: the paths of Ray's sockets would be too long.
        folder = stack.enter_context(short_folder())
        begin = ("-m", "ray.scripts.scripts", "start", *common)
        options = [(*head, *quiet, "--temp-dir", folder)] + n_workers * [("--address", f"{host}:{port}", "--num-cpus", 1)]
        for number, own in enumerate(options):
            log = folder / f"start{number}.log"
            process = stack.enter_context(running(*begin, *own, log=log))
            wait_until(lambda log=log: "Ray runtime started" in log.read_text(), process, log)
        yield f"{host}:{port}"


@contextmanager
def dask_cluster(n_workers=2, n_threads=1):
    """A scheduler, and workers with one thread each.

    :return: address of the scheduler
    """
    port = free_port()
    address = f"tcp://{HOST}:{port}"
    with ExitStack() as stack:
        folder = stack.enter_context(short_folder())
        log = folder / "scheduler.log"
        scheduler = ("-m", "distributed.cli.dask_scheduler", "--host", HOST, "--port", port, "--no-dashboard")
        process = stack.enter_context(running(*scheduler, log=log))
        wait_until(lambda: "Scheduler at" in log.read_text(), process, log)
        worker = ("-m", "distributed.cli.dask_worker", address, "--host", HOST, "--nworkers", 1, "--nthreads", n_threads)
        for number in range(n_workers):
            own_log = folder / f"worker{number}.log"
            own = ("--no-dashboard", "--local-directory", folder / str(number))
            process = stack.enter_context(running(*worker, *own, log=own_log))
            wait_until(lambda own_log=own_log: "Registered to" in own_log.read_text(), process, own_log)
        yield address


@contextmanager
def short_folder():
    folder = Path(tempfile.mkdtemp(prefix="cl"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def running(*arguments, log):
    """A Python process in a session of its own, which is ended with all processes of that session."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}  # the jobs of a test are defined in its file
    with log.open("w") as file:
        options = dict(stdout=file, stderr=subprocess.STDOUT, env=environment, cwd=log.parent, start_new_session=True)
        process = subprocess.Popen([sys.executable, *map(str, arguments)], stdin=subprocess.DEVNULL, **options)
    try:
        yield process
    finally:
        for member in members(process.pid):
            member.kill()
        process.wait(timeout=10)


def members(session):
    """The processes of a session."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session:
                found.append(process)
        except ProcessLookupError:
            continue
    return found


def wait_until(ready, process, log):
    end = time.monotonic() + SECONDS_TO_START
    while not ready():
        assert process.poll() is None, f"{process.args} ended:\n{log.read_text()}"
        assert time.monotonic() < end, f"{process.args} did not start:\n{log.read_text()}"
        time.sleep(0.1)


def free_port():
    """Above the ports that Ray gives its workers and clients, 10002 to 24000, and below those that systems give out."""
    while True:
        port = random.randint(25_000, 32_000)
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)):
                return port
