"""What the report shows of control allocation: methods on a recorded pitch demand, on three axes, and inside dispersed loops."""

from __future__ import annotations

from typing import TYPE_CHECKING

from allocation.compare import COLUMNS
from studies import allocation, blend_methods
from studies.result import Cell, FigureItem, StudyResult, Table

if TYPE_CHECKING:
    from studies.allocation import AllocationStudy


def result(*, flights: int = 200, slow: int = 200, bound_samples: int = 100, until: float = 120.0) -> StudyResult:
    """Compare all installed methods.

    Parameters
    ----------
    flights : int
        Dispersed flights under each method that runs inside the loop, >= 2.
    slow, bound_samples : int
        Samples for back ends and predictive method, and for the mixed-integer bound (a fifth of them on three axes).
    until : float
        End of the recorded demand, s.

    Returns
    -------
    StudyResult
    """
    pitch = allocation.run(allocation.recorded_pitch_history(until=until), slow=slow, bound_samples=bound_samples)
    axes = allocation.run(
        allocation.three_axis_history(), slow=slow, bound_samples=bound_samples // 5
    )  # its mixed-integer programs are large
    loops = blend_methods.compare(cases=flights)
    return StudyResult(
        name="allocation",
        title="Allocation methods side by side",
        lead=(
            "The same demands under every method: the recorded pitch demand of the STS-1 case, where the hand-over logic of Lu and Zhang "
            "(2012) has an answer, and three axes with surfaces and jets that compete, where it has none. Times are those of this machine "
            "and this run."
        ),
        figures=[
            FigureItem(
                "pitch_residuals", "Recorded pitch demand", "Moment demanded and moment unmet by each method, N m.",
                pitch.figures()["residuals"],
            ),
            FigureItem(
                "difference", "Equation 20 and the quadratic program",
                "Below half a degree of demand the printed logic gives more than is asked; above they agree.",
                allocation.difference_figure(),
            ),
            FigureItem(
                "three_axis_residuals", "Three axes", "Moment demanded and moment unmet on each axis, N m.", axes.figures()["residuals"]
            ),
            FigureItem(
                "attainable", "Attainable set", "All moments of the three-axis case, with the demands, N m.", axes.figures()["attainable"]
            ),
        ],
        tables=[
            *_tables("Recorded pitch demand", pitch), *_tables("Three axes with rate limits", axes), loops.table(), loops.differences(),
        ],
        data={"pitch": pitch.to_dict(), "three_axis": axes.to_dict(), "loops": loops.to_dict()},
    )  # fmt: skip


def _tables(title: str, study: AllocationStudy) -> list[Table]:
    def rows(same: bool) -> list[list[Cell]]:
        return [[cell if isinstance(cell, str) else float(cell) for cell in row] for row in study.comparison.rows(same=same)]

    note = (
        "Errors relative to the scale of the demand. Worst KKT residual of the answers, and how many fail the workbench's own check. "
        "The on-off bound is of each cycle by itself, and each effector is one switch. " + study.remark
    ).strip()
    whole = Table(title, COLUMNS, rows(False), f"{note} Slow methods were given a part of the samples: compare them in the next table.")
    same = Table(f"{title}: all methods on the same samples", COLUMNS, rows(True), note)
    return [whole, same]
