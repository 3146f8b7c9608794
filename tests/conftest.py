"""Settings shared by all tests."""

import os
import signal

import hypothesis

os.environ.setdefault("MPLBACKEND", "Agg")  # no test opens a window

# A shell starts background jobs with Ctrl-C ignored, and processes that tests start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run: a failure is a failure of the change at hand.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None, print_blob=False)
hypothesis.settings.load_profile("fixed")
