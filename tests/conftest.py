"""Settings shared by all tests, and what tests of several files use: the command line called in place, random jet loops."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import hypothesis
import numpy as np
import pytest

Run = Callable[..., tuple[int, str, str]]

os.environ.setdefault("MPLBACKEND", "Agg")  # no test opens a window

# A shell starts background jobs with Ctrl-C ignored, and processes that tests start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run: a failure is a failure of the change at hand.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None, print_blob=False)
hypothesis.settings.load_profile("fixed")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call ``reentry`` with the given arguments in an empty folder: (exit code, standard output, error output)."""
    from studies import cli

    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main([str(a) for a in arguments])
        taken = capsys.readouterr()
        return code, taken.out, taken.err

    return call


def random_loops(count: int, seed: int) -> np.ndarray:
    """Rows (a, u_on, u_off, tau) of jet loops over many decades, shape (count, 4)."""
    rng = np.random.default_rng(seed)
    a, u_on, tau = (10 ** rng.uniform(low, high, count) for low, high in ((-4, 1), (-2, 1), (-1.5, 1.5)))
    return np.column_stack([a, u_on, u_on * rng.uniform(0, 1, count), tau])
