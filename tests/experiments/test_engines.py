"""The engines: same results to the byte, dead workers, errors. Ray and Dask run as clusters of separate processes."""

import inspect
import itertools
import os
import pickle
import signal
import subprocess
import sys
import time
import warnings

import cloudpickle
import numpy as np
import psutil
import pytest
from helpers import engine_jobs as examples
from helpers.clusters import HOST, dask_cluster, free_port, ray_cluster, silent_port
from helpers.engine_jobs import Job, Learning
from threadpoolctl import threadpool_limits

from sb3_combrel import SourceInstances
from sb3_combrel.experiments import engine_jobs, local_processes
from sb3_combrel.experiments.engines import ENGINES, JobError, carry_out_on
from sb3_combrel.experiments.runs import make_task

SECONDS_PER_TEST = 58
CLUSTERS = ("ray", "dask")


@pytest.fixture(autouse=True)
def no_hanging():
    """A test that hangs fails."""

    def fail(*_):
        pytest.fail(f"the test took more than {SECONDS_PER_TEST} seconds")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(SECONDS_PER_TEST)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module", params=ENGINES)
def where(request):
    """Engine and the arguments that it needs, with two workers."""
    if request.param == "joblib":
        yield "joblib", {"n_jobs": 2}
    elif request.param == "ray":
        with ray_cluster() as address:
            yield "ray", {"address": address}
    else:
        with dask_cluster() as address:
            yield "dask", {"address": address}


@pytest.fixture
def carry_out(where):
    """carry_out_on with the engine's arguments; its generators are closed after the test."""
    engine, options = where
    generators = []

    def begin(function, jobs):
        generators.append(carry_out_on(engine, function, jobs, **options))
        return generators[-1]

    yield begin
    for generator in generators:
        generator.close()


@pytest.fixture(scope="module")
def learning_runs():
    """Learning runs and what they give in this process, which compiles what they need."""
    env = make_task("combrel/MountainCar2D-v0")
    source = SourceInstances.from_q_learning(env, n_instances=100, seed=0, total_timesteps=2000)
    env.close()
    runs = [Learning(0), Learning(1), Learning(1, source)]
    with threadpool_limits(1):
        return runs, [pickle.loads(cloudpickle.dumps(examples.learn(run))) for run in runs]


def results_of(generator):
    """Results in the order of the jobs."""
    found = dict(generator)
    return [found[index] for index in sorted(found)]


def attempts_of(jobs):
    return {job.name: len(job.attempts()) for job in jobs}


def is_alive(pid):
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


@pytest.mark.integration
class TestOnEachEngine:
    def test_learning_runs_have_the_results_of_this_process_to_the_byte(self, carry_out, learning_runs):
        runs, expected = learning_runs
        found = results_of(carry_out(examples.learn, runs))
        assert [pickle.dumps(result) for result in found] == [pickle.dumps(result) for result in expected]
        assert len({pickle.dumps(result) for result in found}) == len(runs)

    def test_every_job_is_carried_out_once(self, carry_out, tmp_path):
        jobs = [Job(f"job{number}", tmp_path, np.full(3, number)) for number in range(7)]
        found = results_of(carry_out(examples.double, jobs))
        np.testing.assert_array_equal(found, [2 * job.array for job in jobs])
        assert attempts_of(jobs) == {job.name: 1 for job in jobs}

    def test_results_come_as_jobs_finish(self, carry_out, tmp_path):
        slow = Job("slow", tmp_path, dies=1)
        jobs = [slow, *(Job(f"quick{number}", tmp_path) for number in range(3))]
        order = []
        for index, _ in carry_out(examples.wait_for_the_end_first, jobs):
            order.append(index)
            if len(order) == 3:
                os.kill(slow.wait_for_attempt(), signal.SIGKILL)
        assert sorted(order[:3]) == [1, 2, 3]
        assert order[3:] == [0]

    def test_a_worker_killed_in_the_middle_loses_only_its_unfinished_job_which_is_begun_again(self, carry_out, tmp_path):
        victim = Job("victim", tmp_path, dies=1)
        jobs = [victim, *(Job(f"job{number}", tmp_path) for number in range(6))]
        found = {}
        for index, result in carry_out(examples.wait_for_the_end_first, jobs):
            if not found:
                os.kill(victim.wait_for_attempt(), signal.SIGKILL)
            found[index] = result
        assert found == {index: job.name for index, job in enumerate(jobs)}
        assert attempts_of(jobs) == {job.name: 1 for job in jobs} | {"victim": 2}

    def test_a_job_that_kills_every_worker_is_given_up(self, carry_out, tmp_path):
        job = Job("deadly", tmp_path)
        with pytest.raises(JobError, match=r"^deadly: .*died|^deadly: .*(?i:killed|crashed)"):
            list(carry_out(examples.kill_itself, [job]))
        assert len(job.attempts()) == 1 + engine_jobs.MAX_DEATHS

    def test_an_exception_of_a_job_reaches_the_caller_with_its_name_and_is_not_tried_again(self, carry_out, tmp_path):
        job = Job("COMBREL, seed 3", tmp_path)
        with pytest.raises(JobError) as caught:
            list(carry_out(examples.fail, [job]))
        message = str(caught.value)
        assert message.splitlines()[0] == "COMBREL, seed 3: FileNotFoundError: [Errno 2] No such file: 'lost.npz'"
        assert "in fail\n" in message
        assert len(job.attempts()) == 1

    def test_a_result_that_cannot_be_pickled_is_an_error_of_its_job(self, carry_out, tmp_path):
        with pytest.raises(JobError, match=r"^locked: TypeError: cannot pickle"):
            list(carry_out(examples.return_a_lock, [Job("locked", tmp_path)]))

    def test_large_arrays_can_be_written_to_on_workers_and_in_results(self, carry_out, tmp_path):
        [result] = results_of(carry_out(examples.write_into_its_array, [Job("large", tmp_path, np.zeros(500_000))]))
        result += 1
        np.testing.assert_array_equal(result, np.full(500_000, 2.0))

    def test_workers_use_one_thread(self, carry_out, tmp_path):
        [result] = results_of(carry_out(examples.count_threads, [Job("threads", tmp_path)]))
        assert result == ("1", 1, {1})

    def test_closing_the_generator_ends_what_runs_and_what_waits(self, carry_out, tmp_path, where):
        jobs = [Job(f"long{number}", tmp_path) for number in range(4)]
        generator = carry_out(lambda job: examples.sleep_long(job) if job.name != "long1" else job.name, jobs)
        assert next(generator) == (1, "long1")
        pid = jobs[0].wait_for_attempt()
        generator.close()
        begun = attempts_of(jobs)
        # Dask's workers live on; that they are free is shown by what they do next.
        after = [Job(f"after{number}", tmp_path, np.ones(1)) for number in range(2)]
        assert len(results_of(carry_out(examples.double, after))) == 2
        assert where[0] == "dask" or not is_alive(pid)
        assert attempts_of(jobs) == begun

    def test_no_jobs_have_no_results(self, carry_out):
        assert list(carry_out(examples.double, [])) == []

    def test_a_function_of_the_callers_own_script_can_be_used(self, carry_out, tmp_path):
        assert results_of(carry_out(lambda job: job.name, [Job("a", tmp_path)])) == ["a"]


@pytest.mark.integration
def test_interrupting_a_program_ends_its_workers_without_noise(tmp_path):
    code = """
import sys
from pathlib import Path
from helpers.engine_jobs import Job, sleep_long
from sb3_combrel.experiments.engines import carry_out_on
try:
    list(carry_out_on("joblib", sleep_long, [Job(f"long{n}", Path(sys.argv[1])) for n in range(3)], n_jobs=2))
except KeyboardInterrupt:
    print("interrupted")
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    program = subprocess.Popen(
        [sys.executable, "-c", code, tmp_path],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        pids = [Job(f"long{number}", tmp_path).wait_for_attempt() for number in range(2)]
        os.killpg(program.pid, signal.SIGINT)
        output, errors = program.communicate(timeout=60)
    finally:
        program.kill()
    assert (output, errors) == ("interrupted\n", "")
    assert not any(map(is_alive, pids))


@pytest.mark.integration
@pytest.mark.parametrize(("engine", "cluster"), [("ray", ray_cluster), ("dask", dask_cluster)])
def test_a_cluster_without_workers(engine, cluster, tmp_path):
    with cluster(n_workers=0) as address:
        with pytest.raises(ConnectionError, match=f"the {engine} cluster at {address} has no workers. Start"):
            list(carry_out_on(engine, examples.double, [Job("a", tmp_path)], address=address))


@pytest.mark.integration
def test_an_interrupt_while_a_job_is_begun_leaves_no_process_that_nobody_ends(tmp_path, monkeypatch):
    new_pool = local_processes._new_pool

    def interrupted():
        signal.raise_signal(signal.SIGINT)
        return new_pool()

    monkeypatch.setattr(local_processes, "_new_pool", interrupted)
    packed = engine_jobs.pack(examples.double, Job("a", tmp_path, np.ones(2)), 0)
    processes = local_processes._Processes(1)
    try:
        with pytest.raises(KeyboardInterrupt):
            processes.submit(0, packed.payload)
        [(future, (index, pool))] = processes.running.items()
        assert index == 0
        # Before that loky's thread would raise an exception if the pool were ended.
        assert future.running() or future.done()
    finally:
        processes.kill()
    assert not pool._processes
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.integration
def test_a_scheduler_of_dask_that_dies_is_one_error_without_noise(tmp_path, capfd):
    with dask_cluster(n_workers=1) as address:
        generator = carry_out_on(
            "dask", sleep_but_the_first, [Job(name, tmp_path) for name in ("quick", "slow")], address=address
        )
        assert next(generator) == (0, "quick")
        port = int(address.rpartition(":")[2])
        [scheduler] = {c.pid for c in psutil.net_connections("tcp") if c.status == "LISTEN" and c.laddr.port == port}
        os.kill(scheduler, signal.SIGKILL)
        with pytest.raises(ConnectionError, match=f"the connection to the Dask scheduler at {address} was lost"):
            next(generator)
    assert capfd.readouterr() == ("", "")


def sleep_but_the_first(job):
    return job.name if job.name == "quick" else examples.sleep_long(job)


@pytest.mark.integration
def test_workers_of_dask_with_several_threads_do_one_job_at_a_time(tmp_path):
    with dask_cluster(n_workers=1, n_threads=3) as address:
        jobs = [Job(f"job{number}", tmp_path) for number in range(3)]
        with pytest.warns(UserWarning, match="start them with --nthreads 1"):
            found = results_of(carry_out_on("dask", time_of, jobs, address=address))
    intervals = sorted(found)
    assert all(end <= next_begin for (_, end), (next_begin, _) in itertools.pairwise(intervals))


def time_of(job):
    begin = time.monotonic()
    time.sleep(0.3)
    return begin, time.monotonic()


# The workers cannot import this module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


class TestBadInput:
    def test_unknown_engine(self):
        with pytest.raises(ValueError, match="backend must be one of joblib, ray, dask, got 'spark'"):
            carry_out_on("spark", examples.double, [])

    def test_address_for_local_processes(self):
        with pytest.raises(ValueError, match=r"address is for the backends ray and dask.*got '127.0.0.1:1'"):
            carry_out_on("joblib", examples.double, [], address="127.0.0.1:1")

    @pytest.mark.parametrize("engine", CLUSTERS)
    @pytest.mark.parametrize("address", [None, ""])
    def test_cluster_without_address(self, engine, address):
        with pytest.raises(ValueError, match=f"backend {engine} needs the address of a running cluster, such as .*Start one"):
            carry_out_on(engine, examples.double, [], address=address)

    @pytest.mark.parametrize("engine", CLUSTERS)
    def test_number_of_jobs_for_a_cluster(self, engine):
        with pytest.raises(ValueError, match=f"jobs is for the backend joblib; with {engine} the cluster decides, got 3"):
            carry_out_on(engine, examples.double, [], address="127.0.0.1:1", n_jobs=3)

    @pytest.mark.parametrize("n_jobs", [0, -1, 1.5, True])
    def test_number_of_jobs_that_is_none(self, n_jobs):
        with pytest.raises(ValueError, match="jobs must be a whole number of at least 1 or None"):
            carry_out_on("joblib", examples.double, [], n_jobs=n_jobs)

    @pytest.mark.parametrize(("engine", "package", "extra"), [("ray", "ray", "ray"), ("dask", "distributed", "dask")])
    def test_engine_that_is_not_installed(self, engine, package, extra, monkeypatch):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ModuleNotFoundError, match=rf"needs {package}.*pip install 'sb3-combrel\[{extra}\]'"):
            carry_out_on(engine, examples.double, [], address="127.0.0.1:1")

    def test_job_that_cannot_be_pickled(self, tmp_path):
        with pytest.raises(ValueError, match=r"bound cannot be sent to a worker, its pickling failed: .*lock"):
            carry_out_on("joblib", examples.double, [Job("bound", tmp_path, examples.return_a_lock(None))])

    @pytest.mark.parametrize("engine", CLUSTERS)
    @pytest.mark.parametrize(
        "address", ["localhost", "127.0.0.1:no", "http://127.0.0.1:80", "ray://127.0.0.1", ":8786", "127.0.0.1:99999"]
    )
    def test_address_that_cannot_be_one(self, engine, address):
        with pytest.raises(ValueError, match=f"address of {engine} must be a host and a port, such as .*got '{address}'"):
            list(carry_out_on(engine, examples.double, [1], address=address))

    def test_address_of_the_client_server_of_ray(self):
        with pytest.raises(ValueError, match=r'address of ray must be .* such as "10.0.0.1:6379", got \'ray://'):
            list(carry_out_on("ray", examples.double, [1], address="ray://127.0.0.1:10001"))

    @pytest.mark.parametrize("engine", CLUSTERS)
    def test_address_where_nothing_listens(self, engine, capfd):
        address = f"{HOST}:{free_port()}"
        begin = time.monotonic()
        with pytest.raises(
            ConnectionError, match=f"no {engine} cluster answers at {address} .*refused.*Start one with: "
        ) as e:
            list(carry_out_on(engine, examples.double, [1], address=address))
        assert time.monotonic() - begin < 10
        assert "\n" not in str(e.value)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.integration
    @pytest.mark.parametrize("address", ["{}", "tcp://{}"])
    def test_address_where_something_else_listens(self, address, capfd):
        engine = "dask" if "tcp" in address else "ray"
        with silent_port() as port:
            address = address.format(f"{HOST}:{port}")
            begin = time.monotonic()
            with pytest.raises(ConnectionError, match=f"no {engine} cluster answers at {address} .*Start one with: ") as e:
                list(carry_out_on(engine, examples.double, [1], address=address))
        assert time.monotonic() - begin < 20
        assert "\n" not in str(e.value)
        assert capfd.readouterr() == ("", "")


class TestJobs:
    def test_another_version_of_the_package_on_the_worker(self):
        packed = engine_jobs.pack(examples.double, np.ones(1), 0)
        with pytest.raises(
            JobError, match=r"^job 0: RuntimeError: the worker has sb3-combrel .*, the caller 0\.0\.0; install"
        ):
            engine_jobs.unpack(packed.name, engine_jobs.perform(packed.payload, "0.0.0", "test"))

    def test_a_caller_that_has_stopped_gets_no_result(self):
        packed = engine_jobs.pack(examples.double, np.ones(1), 0)
        engine_jobs.stop("stopped")
        with pytest.raises(engine_jobs.Stopped):
            engine_jobs.perform(packed.payload, engine_jobs.__version__, "stopped")

    def test_the_error_can_be_pickled(self):
        error = JobError("run", "ValueError: bad", "trace")
        again = pickle.loads(pickle.dumps(error))
        assert (str(again), again.name) == (str(error), "run")
        assert str(JobError("run", "reason")) == "run: reason"

    def test_the_function_of_the_worker_takes_what_the_engines_send(self):
        assert list(inspect.signature(engine_jobs.perform).parameters) == ["payload", "version", "caller"]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert engine_jobs.pack(len, "abc", 4).name == "job 4"
