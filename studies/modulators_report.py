"""Tables, *paper | computed* rows and text of the modulator study."""

from __future__ import annotations

from typing import TYPE_CHECKING

from models.census_map import shown_word
from models.modulators_static import RANGES, advice, minimum_pulse
from models.sampled_cycles import limits_mc1
from studies.modulators import CONTINUOUS, CURVES, M1, M2, PAPER, SCHEMES, STRAY_GAIN, ending_word
from studies.modulators_figures import figures
from studies.result import Cell, Comparison, Headline, StudyResult, Table

if TYPE_CHECKING:
    from studies.modulators import Border, ModulatorStudy

_LEAD = (
    "Lu and Zhang (2012) turn the demand on a re-entry vehicle's jets into pulses by a sampled pulse-width pulse-frequency modulator, and "
    "find by discrete describing functions when it oscillates without any demand. Beside each of their predictions stands here the "
    "complete census of the modulator: every steady output from any state, with proof. A word such as {+0-0} is one period of the output, "
    "one sign for each sample; M_c is the paper's number of samples on each side."
)
_PRINT = "No formula is printed for this cycle; the paper's recursion and the census both give this value: the print is taken for a slip."


def result(study: ModulatorStudy) -> StudyResult:
    """Everything the report shows of the study."""
    return StudyResult(
        name="modulators", title="Jet modulation and its limit cycles", lead=_LEAD, figures=figures(study), tables=tables(study),
        comparisons=comparisons(study), data=study.to_dict(), headlines=headlines(study),
    )  # fmt: skip


def headlines(study: ModulatorStudy) -> list[Headline]:
    """The cards of the study."""
    quiet = float(study.map.quiet.mean())
    gain = _border(study, "M_c = 1", "k", "delta = 0")
    return [
        Headline("Quiet below k", gain.formula, "", "M_c = 1 begins here, delta = 0; printed 0.7669"),
        Headline("Steady outputs, scheme b", len(study.censuses["b"].words), "", "the jets end up off from any state"),
        Headline("Map proven quiet", 100 * quiet, "%", "of 0 ≤ k ≤ 6, 0 ≤ delta ≤ 0.1125", 3),
        Headline("Map undecided", 100 * float((~study.map.decided).mean()), "%", "a limit point lies on a threshold", 2),
    ]


def tables(study: ModulatorStudy) -> list[Table]:
    """Tables 1 to 4 and the duty cycles that can be told exactly."""
    return [_ranges(), _predictions(study), _limits(study), _schemes(study), _duties(study), _censuses(study)]


def _ranges() -> Table:
    rows: list[list[Cell]] = []
    for name, (low, high) in RANGES.items():
        scale = CONTINUOUS.u_on if name == "h" else 1.0
        value = float(getattr(CONTINUOUS, name))
        rows.append([name, low * scale, high * scale, value, "yes" if low * scale <= value <= high * scale else "no"])
    remarks = "; ".join(str(a) for a in advice(CURVES["h = 0.2, k = 1"]))
    return Table(
        "Recommended parameters (Table 1) and the first choice", ["parameter", "from", "to", "first choice", "inside"], rows,
        f"h from 0.2 to 0.8 of u_on = 0.45. Advice on the sampled modulator with h = 0.2: {remarks}.",
    )  # fmt: skip


def _predictions(study: ModulatorStudy) -> Table:
    rows: list[list[Cell]] = []
    modes = [p.mode for p in next(iter(study.predictions.values()))]
    for i, mode in enumerate(modes):
        cells: list[Cell] = ["cycle" if found[i].predicted else "none" for found in study.predictions.values()]
        exists: list[Cell] = ["yes" if _has(study, name, mode.word) else "no" for name in ("original", "k = 1")]
        rows.append([mode.period, str(mode.mc), shown_word(mode.word), *cells, *exists])
    heads = [f"predicted, k = {k:g}" for k in study.predictions]
    return Table(
        "Modes of 2 to 5 samples (Table 2): predicted by the discrete describing function, and there by the census",
        ["period", "M_c", "word", *heads, "there, k = 0.8", "there, k = 1"], rows,
        "For periods 3 and 5 a mode has several orders of its samples. Predicted: the linear part at the frequency of the cycle lies in "
        "the set of -1/N of the word. For period 4 the prediction is exact, because the word has no harmonics of its own.",
    )  # fmt: skip


def _has(study: ModulatorStudy, name: str, word: tuple[int, ...]) -> bool:
    turned = {word[i:] + word[:i] for i in range(len(word))}
    return any(found in turned for found in study.censuses[name].words)


_PRINTED = {
    ("M_c = 1", "k", "delta = 0", 0): 0.7669, ("M_c = 1", "k", "delta = 0", 1): 5.1125, ("M_c = 1", "delta", "k = 1", 0): 0.0342,
    ("M_c = 1", "delta", "k = 0.8", 0): 0.0049, ("M_c = 2", "k", "delta = 0", 0): 0.9023, ("M_c = 2", "delta", "k = 1", 0): 0.0128,
}  # fmt: skip


def _numbered(study: ModulatorStudy) -> list[tuple[Border, float | None]]:
    """Borders with what Table 3 prints for them."""
    seen: dict[tuple[str, str, str], int] = {}
    rows = []
    for border in study.borders:
        key = (border.cycle, border.parameter, border.fixed)
        rows.append((border, _PRINTED.get((*key, seen.get(key, 0)))))
        seen[key] = seen.get(key, 0) + 1
    return rows


def _border(study: ModulatorStudy, cycle: str, parameter: str, fixed: str) -> Border:
    return next(b for b in study.borders if (b.cycle, b.parameter, b.fixed) == (cycle, parameter, fixed))


def _limits(study: ModulatorStudy) -> Table:
    rows: list[list[Cell]] = []
    for border, printed in _numbered(study):
        low, high = sorted(border.census)
        rows.append([border.cycle, border.parameter, border.fixed, printed, border.formula, low, high])
    return Table(
        "Ends of the two cycles of period 4 (Table 3)", ["cycle", "parameter", "at", "printed", "formula", "census from", "to"], rows,
        "The census changes its answer between its two numbers, which are at most 1e-9 apart. Beyond k = 5.1125 only M_c = 1 ends: at "
        f"k = {STRAY_GAIN:g} the census finds {_words(study, f'k = {STRAY_GAIN:g}')}.",
    )  # fmt: skip


def _words(study: ModulatorStudy, name: str) -> str:
    return ", ".join(shown_word(w) for w in study.censuses[name].words)


def _schemes(study: ModulatorStudy) -> Table:
    rows: list[list[Cell]] = []
    for name, m in SCHEMES.items():
        track, answer = study.scheme_tracks[name], study.harmonics[name]
        rows.append([name, m.k, m.delta, _words(study, name), answer.gain, 1e3 * answer.delay, answer.mean, track.rms])
    return Table(
        "Schemes (Table 4) with all their steady outputs, and their answer to 0.8 sin(t)",
        ["scheme", "k", "delta", "steady outputs", "gain", "delay [ms]", "mean output", "impulse error, rms [s]"], rows,
        "All: km = 4, tau_m = 0.2 s, u_on = 0.45, h = 0. Gain, delay and mean: fundamental of the output over 400 s; impulse error: the "
        "13 s of the figure, in seconds of full thrust. Fig. 8 is printed without numbers. Scheme a changes the gain of the harmonic, "
        "scheme b keeps it but fires its offset on top, a steady mean that an outer loop has to balance.",
    )  # fmt: skip


def _duties(study: ModulatorStudy) -> Table:
    i = round(0.5 * (len(study.r) - 1))
    rows: list[list[Cell]] = [["continuous", float(study.continuous[i]), "closed form", None]]
    for name, found in study.sampled.items():
        rows.append([name, float(found.duty[i]), str(found.fraction(i)), float(found.decided.mean() * 100)])
    return Table(
        "Duty cycle for r = 0.5", ["modulator", "duty cycle", "exactly", "share of the curve decided [%]"], rows,
        "From rest. A sampled modulator ends in a word, so its duty cycle is a fraction of whole numbers.",
    )  # fmt: skip


def _censuses(study: ModulatorStudy) -> Table:
    rows: list[list[Cell]] = []
    for name, found in study.censuses.items():
        for cycle in found.cycles:
            rows.append(
                [name, shown_word(cycle.word), cycle.period, cycle.margin, 100 * cycle.basin.fraction, "yes" if found.decided else "no"]
            )
    return Table(
        "All steady outputs without a demand", ["modulator", "word", "period", "margin", "basin [%]", "complete, proven"], rows,
        "Margin: least distance of the trigger's input from a threshold. Basin: share of the states from which it is reached.",
    )  # fmt: skip


def comparisons(study: ModulatorStudy) -> list[Comparison]:
    """Printed numbers beside ours."""
    high, low = limits_mc1(CURVES["h = 0, k = 1"])
    misprint = "Eq 3 gives 12/23 with the paper's values, as its pole 0.7391 = 17/23 does: 0.5237 is a misprint in eq 11."
    rows = [
        Comparison("gain m of the filter (eq 11)", 0.5237, PAPER.m, "1", misprint),
        Comparison("pole n of the filter (eq 11)", 0.7391, PAPER.n, "1", "", 1e-4),
        Comparison("shortest pulse (eq 2)", 10.3, 1e3 * minimum_pulse(CONTINUOUS), "ms", "Printed with three digits.", 0.005),
        Comparison("dead zone u_on/km", 11.0, 100 * PAPER.u_on / PAPER.km, "%", "Printed with two digits.", 0.025),
        Comparison("|x| at a pulse, M_c = 1, k = 1", 0.5868, high, "1", "", 1e-4),
        Comparison("|x| between pulses, M_c = 1, k = 1", 0.0880, abs(low), "1", "", 3e-4),
    ]
    for k, count in ((1.0, 2.0), (0.8, 1.0), (0.5, 0.0)):
        predicted = sum(p.predicted for p in study.predictions[k] if p.mode.period == 4)
        rows.append(Comparison(f"cycles of 4 samples predicted, k = {k:g}", count, float(predicted), "1", "", 1e-9))
    for w, word, name in ((1.0, M1, "5(a)"), (0.5, M2, "5(b)")):
        left = ending_word(study.endings[w])
        says = f"Output {shown_word(left)}" + (f", the word of Fig. {name}." if tuple(left) == word else ".")
        rows.append(Comparison(f"samples in a period after sin({w:g} t) ends", 4.0, float(len(left)), "1", says, 1e-9))
    for border, printed in _numbered(study):
        if printed is not None:
            what = f"{border.cycle}: {border.parameter} at {border.fixed}"
            if border.cycle == "M_c = 2":
                rows.append(Comparison(what, printed, border.formula, "1", _PRINT))
            else:  # to the digits printed
                rows.append(Comparison(what, printed, border.formula, "1", "", 1e-2 if border.parameter == "delta" else 1e-4))
    for name, expected in (("original", 2.0), ("a", 1.0), ("b", 1.0)):
        found = study.censuses[name]
        what = f"steady outputs, scheme {name} (off counted)"
        rows.append(Comparison(what, expected, float(len(found.words)), "1", _words(study, name), 1e-9))
    return rows
