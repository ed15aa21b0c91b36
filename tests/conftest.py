"""What all tests share."""

from __future__ import annotations

import os

from hypothesis import settings

# The same examples every time: a red test is a change of the code. HYPOTHESIS_PROFILE=search looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("search", derandomize=False, max_examples=200)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))
