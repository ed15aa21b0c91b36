"""What a fleet survives: killed and hanging processes, full disks, folders that cannot be written, two runs at once."""

from __future__ import annotations

import json
import math
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fleet_axes import children, command, finish, is_running, make_axes, results, start, studied

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks at processes as Linux shows them")

KILLS = int(os.environ.get("SERVOLENS_KILLS", "4"))
"""`make fleet-kills` asks for 200."""
LONGEST = 240.0


@pytest.fixture(scope="module")
def axes(tmp_path_factory):
    return make_axes(tmp_path_factory.mktemp("fleet") / "axes")


@pytest.fixture(scope="module")
def timed(axes, tmp_path_factory):
    """Results of a run on one processor that nobody disturbed, and the seconds that it took here and now."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    began = time.monotonic()
    finish(axes, out, "--cores", "1")
    took = time.monotonic() - began
    found = results(out)
    assert sorted(found) == ["axis0.json", "axis1.json", "axis2.json", "unreadable.json"]
    assert ['"status": "done"' in text for text in found.values()] == [True, True, True, False]
    verdicts = [json.loads(found[f"axis{i}.json"])["tuning"]["diagnosis"]["verdict"] for i in range(3)]
    assert verdicts == ["explained", "healthy", "healthy"]
    return found, took


@pytest.fixture(scope="module")
def undisturbed(timed):
    return timed[0]


def wait_until(condition, what, seconds=LONGEST):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s in vain until {what}"
        time.sleep(0.05)


def worker_of(run, other_than=0):
    """Return the first process that studies axes, other than one that is known."""
    found = []

    def is_there():
        found[:] = [child for child in children(run.pid) if child != other_than]
        return bool(found) or run.poll() is not None

    wait_until(is_there, "a worker is there")
    assert found, run.communicate()
    return found[0]


def end(run, *, status):
    told, errors = run.communicate(timeout=LONGEST)
    assert run.returncode == status, errors
    assert "Traceback" not in errors
    return told + errors


def test_kills_at_random_moments_lose_nothing_and_double_nothing(axes, timed, tmp_path):
    undisturbed, took = timed
    moments = random.Random(19)
    out, kills, kept, runs = tmp_path / "out", 0, {}, 0
    while kills < KILLS:
        run, runs = start(axes, out, "--cores", "2"), runs + 1
        pause = moments.uniform(0.1, took)  # on two processors it takes less: some runs end first
        try:
            end(run, status=1) if run.wait(pause) == 1 else pytest.fail(run.stderr.read())
        except subprocess.TimeoutExpired:
            workers = children(run.pid)
            of_a_worker = bool(workers) and moments.random() < 0.4
            os.kill(moments.choice(workers) if of_a_worker else run.pid, signal.SIGKILL)
            kills += 1
            if of_a_worker:
                end(run, status=1)
            run.wait()
            wait_until(lambda: not any(map(is_running, workers)) or of_a_worker, "its workers are gone", 10.0)  # noqa: B023 - it is called at once
        for stream in (run.stdout, run.stderr):
            stream.close()
        found = results(out)
        assert {name: undisturbed[name] for name in found} == found, f"after {kills} kills"
        assert kept.keys() <= found.keys(), f"lost after {kills} kills"
        assert len(studied(out)) == len(set(studied(out))), f"studied twice after {kills} kills"
        kept = found
        if len(found) == len(undisturbed):
            assert not list((out / "results").glob(".*"))
            shutil.rmtree(out)
            kept = {}
    finish(axes, out)
    assert results(out) == undisturbed


@pytest.mark.slow
def test_worker_that_is_killed_once_is_replaced_and_its_axis_studied(axes, undisturbed, tmp_path):
    run = start(axes, tmp_path / "out", "--cores", "1")
    os.kill(worker_of(run), signal.SIGKILL)
    end(run, status=1)
    assert results(tmp_path / "out") == undisturbed


@pytest.mark.slow
def test_worker_that_hangs_is_ended_and_its_axis_is_a_row(axes, timed, tmp_path):
    undisturbed, took = timed
    limit = math.ceil(1.5 * took)  # one axis takes less than half of the run
    run = start(axes, tmp_path / "out", "--cores", "1", "--time-limit", str(limit))
    worker = worker_of(run)
    os.kill(worker, signal.SIGSTOP)  # as if it waited for a disk that is gone
    told = end(run, status=1)
    assert "axis0" in told
    assert not is_running(worker)
    found = results(tmp_path / "out")
    assert f"It takes longer than the time limit of {limit} s." in found.pop("axis0.json")
    assert found == {name: text for name, text in undisturbed.items() if name != "axis0.json"}
    again = finish(axes, tmp_path / "out", "--time-limit", "600")  # another limit: it is worth another try
    assert "3 were finished before" in again.stdout
    assert results(tmp_path / "out") == undisturbed


def test_worker_that_takes_too_much_memory_is_ended_and_its_axis_is_a_row(axes, tmp_path):
    finish(axes, tmp_path / "out", "--cores", "1", "--memory-limit", "120")
    found = results(tmp_path / "out")
    assert len(found) == 4
    assert all("more than the memory limit of 120 MiB" in found[f"axis{i}.json"] for i in range(3))


@pytest.mark.slow
def test_interruption_leaves_a_state_from_which_the_same_command_goes_on(axes, undisturbed, tmp_path):
    out = tmp_path / "out"
    run = start(axes, out, "--cores", "1")
    worker = worker_of(run)
    wait_until(lambda: studied(out), "one axis is finished")
    os.kill(run.pid, signal.SIGINT)
    told = end(run, status=130)
    assert told.startswith("servolens: error: interrupted; ")
    assert told.endswith("of 4 axes are finished and kept: run the same command to go on\n")
    wait_until(lambda: not is_running(worker), "the worker is gone", 10.0)
    before = results(out)
    assert 0 < len(before) < 4
    verb = "was" if len(before) == 1 else "were"
    assert f"{len(before)} {verb} finished before" in finish(axes, out).stdout
    assert results(out) == undisturbed


def test_second_run_on_one_folder_is_refused_and_a_dead_one_holds_nothing(axes, undisturbed, tmp_path):
    out = tmp_path / "out"
    run = start(axes, out, "--cores", "1")
    worker_of(run)
    second = subprocess.run(command(axes, out), capture_output=True, text=True, check=False)
    assert second.returncode == 2
    assert second.stderr == (
        f"servolens: error: {out}: another run (process {run.pid}) is writing here; wait for it, or choose another"
        " --out\n"
    )
    os.kill(run.pid, signal.SIGKILL)
    run.communicate()
    finish(axes, out)
    assert results(out) == undisturbed


@pytest.mark.slow
def test_file_size_limit_stops_the_run_with_a_sentence_and_leaves_whole_files_only(axes, undisturbed, tmp_path):
    out = tmp_path / "out"
    small = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (8192, resource.RLIM_INFINITY))  # noqa: E731 - one line
    run = subprocess.run(
        command(axes, out, "--cores", "1"), capture_output=True, text=True, check=False, preexec_fn=small
    )
    assert run.returncode == 2
    assert run.stderr.startswith(
        f"servolens: error: {out / 'results' / 'axis0.json'}: cannot be written (file too large)"
    )
    assert results(out) == {}
    assert not list((out / "results").glob(".*"))
    finish(axes, out)
    assert results(out) == undisturbed


def may_mount():
    if shutil.which("unshare") is None:
        return False
    probe = ["unshare", "--user", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


def mounted(script):
    """Run a script of the shell in a place where it may mount."""
    enter = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script]
    return subprocess.run(enter, capture_output=True, text=True, check=False)


@pytest.fixture
def mounts():
    if not may_mount():
        pytest.skip("no file systems can be mounted here")


@pytest.mark.slow
@pytest.mark.usefixtures("mounts")
def test_full_disk_stops_the_run_with_a_sentence_and_it_goes_on_when_there_is_room(axes, undisturbed, tmp_path):
    out, kept = tmp_path / "out", tmp_path / "kept"
    out.mkdir()
    line = " ".join(command(axes, out, "--cores", "1"))
    done = mounted(f"""
        mount -t tmpfs -o size=52k none {out} && {line} >{tmp_path}/first.out 2>{tmp_path}/first.err
        echo $? >{tmp_path}/first.status; cp -r {out} {kept}
        mount -o remount,size=4m {out} && {line}
        echo $? >{tmp_path}/second.status; cp -r {out}/. {kept}-later
    """)
    assert (tmp_path / "first.status").read_text(encoding="ascii") == "2\n", done
    assert "cannot be written (no space left on device)" in (tmp_path / "first.err").read_text(encoding="utf-8")
    at_first = results(kept)
    assert 0 < len(at_first) < 4
    assert {name: undisturbed[name] for name in at_first} == at_first
    assert (tmp_path / "second.status").read_text(encoding="ascii") == "1\n", done
    assert results(Path(f"{kept}-later")) == undisturbed


@pytest.mark.usefixtures("mounts")
def test_folder_that_cannot_be_written_is_refused_with_a_sentence(axes, tmp_path):
    (tmp_path / "out").mkdir()
    line = " ".join(command(axes, tmp_path / "out" / "deeper"))
    done = mounted(f"mount -t tmpfs -o ro none {tmp_path}/out && exec {line}")
    assert done.returncode == 2
    expected = f"{tmp_path}/out/deeper: cannot be written (read-only file system)"
    assert done.stderr == f"servolens: error: {expected}\n"


def test_results_folder_that_is_a_file_is_refused_with_a_sentence(axes, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "results").write_text("mine", encoding="ascii")
    run = subprocess.run(command(axes, tmp_path / "out"), capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert run.stderr == f"servolens: error: {tmp_path / 'out'}: cannot be written (file exists)\n"


class Cluster:
    """A Dask scheduler and its workers, as processes of their own."""

    def __init__(self):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.processes = []

    def _start(self, *arguments):
        command = [sys.executable, "-m", *map(str, arguments), "--no-dashboard"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.processes.append(process)
        return process

    def scheduler(self):
        scheduler = self._start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", self.port)
        wait_until(self._answers, "the scheduler answers")
        return scheduler

    def _answers(self):
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def worker(self):
        return self._start("distributed.cli.dask_worker", self.address, "--no-nanny", "--nthreads", 1)

    def end(self):
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster():
    found = Cluster()
    yield found
    found.end()


@pytest.mark.slow
def test_dask_worker_that_dies_loses_nothing(axes, undisturbed, cluster, tmp_path):
    out = tmp_path / "out"
    cluster.scheduler()
    first, second = cluster.worker(), cluster.worker()
    run = start(axes, out, "--dask", cluster.address)
    wait_until(lambda: children(first.pid) and children(second.pid), "both workers study")
    first.kill()
    end(run, status=1)
    assert results(out) == undisturbed
    assert sorted(studied(out)) == sorted(name.removesuffix(".json") for name in undisturbed)


@pytest.mark.slow
def test_dask_scheduler_that_restarts_loses_nothing(axes, undisturbed, cluster, tmp_path):
    out = tmp_path / "out"
    scheduler = cluster.scheduler()
    cluster.worker()
    run = start(axes, out, "--dask", cluster.address)
    wait_until(lambda: studied(out), "one axis is finished")
    scheduler.kill()
    scheduler.wait()
    cluster.scheduler()
    cluster.worker()
    told = end(run, status=1)
    assert "Not studied: 1." in told
    assert results(out) == undisturbed


@pytest.mark.slow
def test_dask_scheduler_that_is_gone_for_good_ends_the_run_with_a_sentence(axes, undisturbed, cluster, tmp_path):
    out = tmp_path / "out"
    scheduler = cluster.scheduler()
    cluster.worker()
    run = start(axes, out, "--dask", cluster.address)
    wait_until(lambda: studied(out), "one axis is finished")
    scheduler.kill()
    told = end(run, status=2)
    assert told.startswith(
        "servolens: error: the executor takes no more work (RuntimeError: the connection to the Dask scheduler is lost)"
    )
    assert told.endswith("of 4 axes are finished and kept: run the same command to go on\n")
    assert told.count("\n") == 1
    finish(axes, out)
    assert results(out) == undisturbed


@pytest.mark.slow
def test_dask_address_without_a_scheduler_is_refused_with_a_sentence(axes, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    run = subprocess.run(
        command(axes, tmp_path / "out", "--dask", address), capture_output=True, text=True, check=False
    )
    assert run.returncode == 2
    assert run.stderr.startswith(f"servolens: error: no Dask scheduler answers at {address} (")
    assert run.stderr.count("\n") == 1
