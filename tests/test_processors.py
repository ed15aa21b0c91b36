"""Jobs that are shared among threads and processes."""

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from servolens.processors import PROCESSORS, Tally, in_parallel, in_processes, shared_array


@pytest.fixture(autouse=True)
def two_processors(monkeypatch):
    monkeypatch.setenv(PROCESSORS, "2")


def test_answers_keep_the_order_of_the_jobs():
    assert in_parallel(lambda n: n * n, range(50)) == [n * n for n in range(50)]


def test_jobs_of_a_job_stay_in_its_thread():
    def outer(_):
        own = threading.get_ident()
        return all(ident == own for ident in in_parallel(lambda _: threading.get_ident(), range(8)))

    assert all(in_parallel(outer, range(8)))


def test_single_job_needs_no_thread():
    assert in_parallel(lambda _: threading.get_ident(), [0]) == [threading.get_ident()]


def test_failure_of_a_job_is_raised():
    def fails(n):
        raise ValueError(str(n))

    with pytest.raises(ValueError, match="3"):
        in_parallel(fails, [3, 4])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_child_of_a_process_with_threads_has_threads_of_its_own():
    in_parallel(lambda n: n, range(4))
    child = os.fork()
    if child == 0:
        os._exit(0 if in_parallel(lambda n: n + 1, range(4)) == [1, 2, 3, 4] else 1)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0


copied = pytest.mark.skipif(sys.platform != "linux", reason="processes are not copied here")


@copied
def test_jobs_are_shared_among_processes_and_keep_their_order():
    def job(n):
        time.sleep(0.02)
        return n, os.getpid()

    answers = in_processes(job, range(10), Tally())
    assert [n for n, _ in answers] == [*range(10)]
    assert len({pid for _, pid in answers}) == 2


@copied
def test_what_takes_longest_is_begun_first():
    began = in_processes(lambda n: (time.sleep(0.02), time.monotonic())[1], range(4), Tally(), cost=lambda n: n)
    assert max(began[2:]) < min(began[:2])


@copied
def test_what_jobs_add_in_any_process_is_counted_once():
    tally, told = Tally(), []
    in_processes(tally.add, range(20), tally, told=told.append)
    assert tally.value == sum(range(20))
    assert told == [*range(1, 21)]


@copied
@pytest.mark.parametrize("fate", ["is killed", "hangs", "cannot answer", "is killed amid its answer"])
def test_job_of_a_process_without_answer_is_done_here(fate):
    here, tally, before = os.getpid(), Tally(), children()

    def job(n):
        tally.add(1)
        time.sleep(0.01)
        if os.getpid() == here:
            time.sleep(0.3 * (fate == "is killed amid its answer"))  # reads nothing meanwhile
            return n
        if fate == "is killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if fate == "hangs":
            time.sleep(60.0)
        if fate == "is killed amid its answer":
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGKILL)).start()
            return bytes(10_000_000)
        return lambda: n  # nothing that can be sent

    began = time.monotonic()
    assert in_processes(job, range(6), tally) == [*range(6)]
    assert tally.value == 6
    assert time.monotonic() - began < 30.0
    assert children() == before


def children():
    return {pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


@copied
def test_error_of_the_first_job_that_failed_is_raised_whatever_process_it_ran_in():
    def fails(n):
        time.sleep(0.01)
        raise ValueError(str(n))

    with pytest.raises(ValueError, match="3"):
        in_processes(fails, [3, 4, 5, 6], Tally(), cost=lambda n: n)


@copied
def test_jobs_of_a_job_stay_in_its_process():
    def outer(_):
        time.sleep(0.02)
        own = os.getpid(), threading.get_ident()
        inner = in_processes(lambda _: (os.getpid(), threading.get_ident()), range(4), Tally())
        return all(ident == own for ident in inner)

    assert all(in_processes(outer, range(4), Tally()))


def test_a_thread_does_not_copy_the_process():
    found, told, tally = [], [], Tally()

    def job(n):
        tally.add(n)
        return os.getpid()

    other = threading.Thread(target=lambda: found.extend(in_processes(job, range(8), tally, told=told.append)))
    other.start()
    other.join()
    assert found == [os.getpid()] * 8
    assert tally.value == sum(range(8))
    assert sorted(told) == [*range(1, 9)]


def test_jobs_write_into_a_shared_array_wherever_they_run():
    rows = shared_array((20, 3))

    def fill(i):
        time.sleep(0.002)
        rows[i] = i, os.getpid(), 1.0

    in_processes(fill, range(20))
    assert rows[:, 0].tolist() == [*range(20)]
    assert rows[:, 2].all()
    assert shared_array((0, 5)).shape == (0, 5)


@copied
def test_process_that_works_longer_than_all_others_is_waited_for():
    here = os.getpid()

    def job(_):
        until = time.monotonic() + 3.0
        while os.getpid() != here and time.monotonic() < until:
            pass
        time.sleep(0.05)
        return os.getpid()

    assert set(in_processes(job, range(3))) > {here}


@copied
def test_fault_in_a_job_shows_where_it_is():
    def faulty(n):
        time.sleep(0.01)
        return 1 // n

    with pytest.raises(ZeroDivisionError) as caught:
        in_processes(faulty, [1, 0, 0, 1])
    assert caught.traceback[-1].name == "faulty"


@copied
def test_descriptors_are_given_back_and_none_left_means_no_further_process():
    def descriptors():
        return {int(path.name) for path in Path("/proc/self/fd").iterdir()}

    before = descriptors()
    for _ in range(3):
        in_processes(lambda n: n, range(4))
        with pytest.raises(ZeroDivisionError):
            in_processes(lambda n: n, range(4), cost=lambda n: 1 // n)
    assert descriptors() == before
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(before), hard))
    try:
        assert in_processes(lambda n: n + 1, range(4)) == [1, 2, 3, 4]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


PROGRAM = """
import os, signal, sys, time
from servolens.processors import in_processes
"""
RUNS_FOR_EVER = """
print("begun", flush=True)
while True:
    in_processes(lambda n: n, range(4))
"""
ANSWERS_AT_LENGTH = """
here = os.getpid()
def job(n):
    if os.getpid() == here:
        print("begun", flush=True)
        time.sleep(60.0)
    return bytes(10_000_000)
in_processes(job, range(2))
"""
WAITS = """
here = os.getpid()
signal.signal(signal.SIGTERM, lambda *_: (print("cleaned up", flush=True), os._exit(0)))
def job(n):
    if os.getpid() == here:
        print("begun", flush=True)
    time.sleep(60.0)
in_processes(job, range(2))
"""


@pytest.fixture
def program():
    """Start a program in a group of its own, and wait until it has begun."""
    started = []

    def start(text):
        pipe = subprocess.PIPE
        one = subprocess.Popen(
            [sys.executable, "-c", PROGRAM + text],
            stdout=pipe,
            stderr=pipe,
            text=True,
            start_new_session=True,
            # a shell that runs tests in the background has them ignore Ctrl-C, which a program would inherit
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        started.append(one)
        assert one.stdout.readline() == "begun\n"
        return one

    yield start
    for one in started:
        with suppress(ProcessLookupError):
            os.killpg(one.pid, signal.SIGKILL)
        one.communicate()


def group_of(leader):
    """Return the processes of a group that are not over."""
    alive = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, group = stat.read_text().rpartition(")")[2].split()[:3]
            alive += [stat.parent.name] if int(group) == leader and state != "Z" else []
    return alive


@copied
def test_interruption_is_not_lost_while_a_process_is_copied(program, monkeypatch):
    """But for what comes while an object is done away with, which Python ignores: once of twelve at most."""
    monkeypatch.setenv(PROCESSORS, "3")
    ended = []
    for trial in range(12):
        one = program(RUNS_FOR_EVER)
        time.sleep(0.05 + 0.0137 * trial)
        os.killpg(one.pid, signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            one.wait(10.0)
        ended.append(one.returncode)
    assert ended.count(-signal.SIGINT) >= 11


@copied
def test_no_process_outlives_the_one_that_waits_for_it(program):
    one = program(ANSWERS_AT_LENGTH)
    time.sleep(0.3)
    os.kill(one.pid, signal.SIGKILL)
    one.wait()
    until = time.monotonic() + 10.0
    while group_of(one.pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert not group_of(one.pid)


@copied
def test_what_a_program_does_about_a_signal_it_does_once(program):
    one = program(WAITS)
    time.sleep(0.3)
    os.killpg(one.pid, signal.SIGTERM)
    said, _ = one.communicate(timeout=20.0)
    assert said.count("cleaned up") == 1
