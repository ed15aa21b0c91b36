"""What all tests share."""

from __future__ import annotations

import os

from hypothesis import settings

# The same examples every time: a red test is a change of the code. HYPOTHESIS_PROFILE=search looks for new ones.
# No deadline: a busy machine is no fault.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("search", derandomize=False, max_examples=200, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

# Workers share the machine among themselves: threads of each would only wait for those of the others.
if "PYTEST_XDIST_WORKER" in os.environ:
    for threads in ("SERVOLENS_PROCESSORS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(threads, "1")
