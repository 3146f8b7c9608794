"""Settings shared by all tests."""

import os

import hypothesis

os.environ.setdefault("MPLBACKEND", "Agg")  # no test opens a window

# The same examples in every run: a failure is a failure of the change at hand.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None, print_blob=False)
hypothesis.settings.load_profile("fixed")
