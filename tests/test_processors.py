"""Jobs that are shared among threads."""

import os
import threading

import pytest

from servolens.processors import PROCESSORS, in_parallel


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
