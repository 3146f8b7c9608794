"""Allocation study: orbiter on three axes, recorded pitch demand, own CSV files and their errors, the command."""

import json

import numpy as np
import pytest

from allocation import attainable, blending
from allocation.compare import Method, user_method
from allocation.core import Effectors
from models.checked import ModelError
from models.shuttle_aero import orbiter_aero, orbiter_data
from studies import allocation, cli
from studies.allocation_files import read_history

DEG = np.pi / 180
B = "axis,left,right,up,down\nL,1e5,-1e5,0,0\nM,-1e6,-1e6,2.7e5,-2.5e5\n"
LIMITS = "effector,lower,upper,rate,flow\nleft,-0.3,0.2,0.35,0\nright,-0.3,0.2,0.35,0\nup,0,1,inf,8.2\n# comment\ndown,0,1,inf,8.2\n"


def demand_text(count=60):
    t = 0.06 * np.arange(count)
    rows = [f"{a:.2f},{2e4 * np.sin(a):.6g},{5e5 * np.cos(2 * a):.6g}" for a in t]
    return "t,L,M\n" + "\n".join(rows) + "\n"


@pytest.fixture
def files(tmp_path):
    texts = {"B.csv": B, "L.csv": LIMITS, "D.csv": demand_text()}
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def options(folder, *more):
    return [
        "allocate",
        "compare",
        "--effectiveness",
        str(folder / "B.csv"),
        "--limits",
        str(folder / "L.csv"),
        "--demand",
        str(folder / "D.csv"),
        *more,
    ]


def test_own_files_are_read(files):
    history = read_history(files / "B.csv", files / "L.csv", files / "D.csv")
    assert history.effectors.names == ("left", "right", "up", "down")
    assert history.effectors.axes == ("L", "M")
    assert history.dt == pytest.approx(0.06)
    assert history.effectors.rate.tolist() == [0.35, 0.35, np.inf, np.inf]
    assert history.effectors.B[1] == pytest.approx([-1e6, -1e6, 2.7e5, -2.5e5])
    assert history.demand.shape == (60, 2)
    (files / "D.csv").write_text("M,L\n1,2\n3,4\n", encoding="utf-8")
    swapped = read_history(files / "B.csv", files / "L.csv", files / "D.csv", dt=0.1)
    assert swapped.demand.tolist() == [[2, 1], [4, 3]]
    (files / "D.csv").write_text("t,L,M\n" + "\n".join(f"{0.1 * k:.1f},1,2" for k in range(1, 4)) + "\n", encoding="utf-8")
    assert read_history(files / "B.csv", files / "L.csv", files / "D.csv").dt == 0.1  # (0.3 - 0.1)/2 is 0.09999999999999999


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "D.csv",
            demand_text().replace("\n0.12,", "\n0.12,nan,1\n0.12,"),
            r"D.csv: row 4, column 'L': found 'nan', expected a finite number",
        ),
        ("D.csv", demand_text().replace("\n0.12,", "\n0.13,"), r"D.csv: row 4, column 't': found '0.13'.*equal steps"),
        ("D.csv", "t,L,N\n0,1,1\n", "unknown column 'N'; expected t and the axes L, M"),
        ("D.csv", "L\n1\n", "no column 'M'"),
        ("D.csv", "L,M\n1,2\n", "no column t; give the sample time with --dt"),
        ("D.csv", "t,L,M\n0,1\n", "row 2: has 2 cells, the heading has 3"),
        ("D.csv", "", "has 0 rows"),
        ("B.csv", B.replace("axis", "name"), "found heading 'name', expected axis"),
        ("B.csv", B.replace("-1e6", "strong", 1), "B.csv: row 3, column 'left': found 'strong', expected a finite number"),
        ("B.csv", B.replace("\nM", "\nL"), "column 'axis': found 'L', expected the name of an axis, each once"),
        ("B.csv", B.replace("right", "left"), "the heading 'left' is empty or stands twice"),
        ("L.csv", LIMITS.replace("up,", "top,"), "column 'effector': found 'top', which is no effector"),
        ("L.csv", LIMITS.replace("down,0,1,inf,8.2\n", ""), "no row for the effector 'down'"),
        ("L.csv", LIMITS.replace("0.35", "-1", 1), "column 'rate': found '-1', expected a number >= 0"),
        ("L.csv", LIMITS.replace("-0.3,0.2", "0.3,0.2", 1), r"row 2, column 'lower': found '0.3', above upper 0.2"),
        ("L.csv", LIMITS.replace("up,0", "up,-1"), r"row 4, column 'lower': found '-1', and a flow of 8.2: a jet pushes one way"),
        ("B.csv", B.replace("-1e6", "1_000", 1), "B.csv: row 3, column 'left': found '1_000', expected a finite number"),
        ("L.csv", LIMITS.replace("flow", "fuel"), "unknown column 'fuel'"),
        ("L.csv", LIMITS.replace("-0.3", "inf", 1), "column 'lower': found 'inf', expected a finite number"),
    ],
)
def test_errors_name_file_row_column_and_value(files, capsys, name, text, message):
    (files / name).write_text(text, encoding="utf-8")
    with pytest.raises(ModelError, match=message):
        read_history(files / "B.csv", files / "L.csv", files / "D.csv")
    assert cli.main(options(files)) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err
    assert str(files / name) in printed.err


def test_bytes_that_are_no_text_and_missing_files(files):
    (files / "D.csv").write_bytes(b"t,L\xff,M\n")
    with pytest.raises(ModelError, match="not UTF-8"):
        read_history(files / "B.csv", files / "L.csv", files / "D.csv")
    with pytest.raises(ModelError, match="no such file"):
        read_history(files / "B.csv", files / "missing.csv", files / "D.csv")
    with pytest.raises(ModelError, match="is a folder"):
        read_history(files, files / "L.csv", files / "D.csv")


def test_the_command_compares_own_data(files, capsys):
    chosen = options(files, "--methods", "qp,redistributed,daqp", "--fail", "left=0.1", "--priority", "M=10", "--cost", "up=2", "--json")
    assert cli.main([*chosen, "--out", str(files / "out")]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [row["method"] for row in data["methods"]] == ["QP (own)", "redistributed", "QP (daqp)"]
    assert data["history"]["failed"] == {"left": 0.1}
    assert data["methods"][0]["worst_kkt"] < 1e-9
    assert data["methods"][0]["unsolved"] == 0
    assert data["methods"][1]["worst_kkt"] is None
    assert {p.name for p in (files / "out").iterdir()} == {"allocation.json", "residuals.svg", "attainable.svg"}
    assert cli.main(options(files, "--methods", "qp")) == 0
    printed = capsys.readouterr().out
    assert "QP (own)" in printed
    assert "same" not in printed


def test_the_command_compares_on_the_same_samples(files, capsys):
    chosen = options(files, "--methods", "qp,daqp", "--slow", "2")
    assert cli.main([*chosen, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    own, other = data["same_samples"]
    assert data["methods"][0]["samples"] > own["samples"] == other["samples"] == data["methods"][1]["samples"] == 2
    for key in ("rms", "worst", "propellant_kg"):
        assert own[key] == pytest.approx(other[key], rel=1e-6, abs=1e-9)
    assert cli.main(chosen) == 0
    assert "All methods on the same 2 samples" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "nothing to compare"),
        (["nonsense"], "unknown name 'nonsense'"),
        (["blend", "--dt", "0.1"], "give a scenario or your own data"),
        (["--effectiveness", "B.csv"], "--limits: not given"),
    ],
)
def test_wrong_calls(capsys, arguments, message):
    assert cli.main(["allocate", "compare", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--methods", "magic"], "unknown name 'magic'"),
        (["--fail", "rudder"], "unknown name 'rudder'"),
        (["--fail", "left=x"], "found 'left=x'"),
        (["--fail", "left=9"], "expected a value from -0.3 to 0.2; angles are in radians: did you give degrees?"),
        (["--fail", "=0.1"], "--fail: found '=0.1', expected NAME or NAME=VALUE"),
        (["--fail", "up", "--fail", "up=0.2"], "--fail: up is given twice"),
        (["--priority", "M=1", "--priority", " M=2"], "--priority: M is given twice"),
        (["--cost", "up=1", "--cost", "up=1"], "--cost: up is given twice"),
        (["--methods", ""], "--methods: found '', expected names such as qp,osqp"),
        (["--methods", " , "], "--methods: found ' , ', expected names"),
        (["--methods", "qp,qp"], "--methods: qp is given twice"),
        (["--methods", "qp,bound", "--bound", "0"], "--methods names bound, and --bound 0 leaves it out"),
        (["--priority", "M"], "expected NAME=FACTOR"),
        (["--priority", "M=0"], "expected a factor > 0"),
        (["--dt", "0.1"], "leave one out"),
    ],
)
def test_wrong_options(files, capsys, more, message):
    assert cli.main(options(files, *more)) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed


@pytest.mark.parametrize("command", [["allocate", "compare", "three-axis"], ["blend"], ["gains"], ["modulator", "census"]])
@pytest.mark.parametrize("empty", ["", " "])
def test_a_folder_without_a_name_is_refused(capsys, tmp_path, monkeypatch, command, empty):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*command, "--out", empty]) == 2
    assert "expected a folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_current_folder_may_be_named(files, capsys, monkeypatch):
    (files / "here").mkdir()
    monkeypatch.chdir(files / "here")
    assert cli.main(options(files, "--methods", "qp", "--json", "--out", ".")) == 0
    assert (files / "here" / "allocation.json").is_file()


@pytest.mark.parametrize("limited", [True, False])
@pytest.mark.parametrize("named", ["qp,bound", "qp"])
def test_rates_are_spoken_of_where_one_method_breaks_them(files, capsys, limited, named):
    (files / "D.csv").write_text(demand_text(6), encoding="utf-8")
    if not limited:
        (files / "L.csv").write_text(LIMITS.replace("0.35", "inf"), encoding="utf-8")
    assert cli.main(options(files, "--methods", named, "--bound", "3")) == 0
    assert ("keeps to the rates" in capsys.readouterr().out) == (limited and named == "qp,bound")
    assert cli.main(options(files, "--methods", named, "--bound", "3", "--json")) == 0
    data = json.loads(capsys.readouterr().out)
    assert ("remark" in data) == (limited and named == "qp,bound")
    assert "keeps to the rates" in data.get("remark", "keeps to the rates")


def test_figures_of_a_scenario_have_units_and_those_of_own_data_have_none(files):
    def labels(history):
        figures = allocation.run(history, chosen=["qp"]).figures().values()
        return {text for figure in figures for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text}

    moments = labels(allocation.three_axis_history(samples=20)) - {"t [s]"}
    assert {"M demand [N m]", "M unmet [N m]", "L [N m]", "N [N m]"} <= moments
    assert all(text.endswith(" [N m]") for text in moments)
    assert "M demand [N m]" in labels(allocation.pitch_history(_Flight(120)))
    own = labels(read_history(files / "B.csv", files / "L.csv", files / "D.csv")) - {"t [s]"}
    assert own == {"L", "M", "L demand", "L unmet", "M demand", "M unmet"}


def test_some_demands_on_three_axes_cannot_be_met():
    history = allocation.three_axis_history()
    outside = ~attainable.attainable_set(history.effectors).contains(history.demand)
    assert 0.02 <= outside.mean() <= 0.05
    own = allocation.run(allocation.without_rates(history), chosen=["qp"]).comparison.outcomes[0]
    missed = np.abs(own.residual * history.axis_weight).max(axis=1)
    assert missed[outside].min() > missed[~outside].max()


def test_orbiters_effectors_on_three_axes():
    c = allocation.Condition()
    e = allocation.orbiter_effectors(c)
    assert len(e.names) == 23
    assert e.names[:3] == ("elevon_left", "elevon_right", "body_flap")
    assert np.linalg.matrix_rank(e.B) == 3
    data, aero = orbiter_data()["reference"], orbiter_aero()
    step = 1e-4
    Cm = [float(aero.at(c.mach, c.alpha, c.elevon + s * step, c.flap)["Cm"]) for s in (-1, 1)]
    pitch = c.qbar * data["S_ref_m2"] * data["chord_m"] * (Cm[1] - Cm[0]) / (2 * step)
    assert e.B[1, 0] + e.B[1, 1] == pytest.approx(pitch, rel=2e-2)
    assert e.B[0, 0] == pytest.approx(-e.B[0, 1])
    assert e.lower[0] / DEG == pytest.approx(-23)
    assert e.upper[0] / DEG == pytest.approx(28)
    assert e.B[1, e.index("L1U")] > 0
    assert e.B[2, e.index("L1L")] < 0  # an aft force to the right turns the nose to the left


def test_three_axes_where_equation_20_has_no_answer():
    history = allocation.three_axis_history(samples=40)
    study = allocation.run(history, chosen=["qp", "redistributed"])
    own, classical = (study.comparison[name] for name in ("QP (own)", "redistributed"))
    assert own.unsolved == 0
    assert own.worst_kkt < 1e-9
    assert own.rms < 0.5 * classical.rms
    assert "paper" not in allocation.known_methods(history)
    assert set(study.figures()) == {"residuals", "attainable"}


class _Jets:
    flow_up = flow_down = 8.0

    def moments(self):
        return 2.67e5, -2.53e5


class _Flight:
    """A recorded flight as far as the history reads it."""

    class loop:
        jets = _Jets()

    def __init__(self, count=600):
        t = 0.01 * np.arange(count)
        rng = np.random.default_rng(0)
        self.columns = {
            "qbar": 600 + 400 * t, "trim": -10 * DEG + 0 * t, "slope": -1e5 * (600 + 400 * t) / 1000,
            "demand": np.where(rng.random(count) < 0.5, 1, -1) * rng.uniform(0.5, 12, count) * DEG,
        }  # fmt: skip
        self.t = t

    def __getitem__(self, name):
        return self.columns[name]


def test_recorded_pitch_demand_through_the_hand_over():
    history = allocation.pitch_history(_Flight(), until=5.5)
    assert len(history) == 92
    assert history.dt == pytest.approx(0.06)
    study = allocation.run(history, chosen=["paper", "literal", "qp", "redistributed"])
    paper, own = study.comparison["paper logic"], study.comparison["QP (own)"]
    assert own.u == pytest.approx(paper.u, abs=1e-6)
    assert own.worst_kkt < 1e-9
    assert study.comparison["equation 20 as printed"].propellant >= paper.propellant
    low, high = history.lower[:, 0], history.upper[:, 0]
    assert (low >= blending.Handover().lower).all()
    assert low[0] == high[0] == 0  # below q1 the elevon trims only


def test_a_users_method_enters_the_study():
    history = allocation.three_axis_history(samples=5)
    mine = user_method("mine", lambda effectors, demand, previous: np.zeros(len(effectors.names)))
    assert isinstance(mine, Method)
    study = allocation.run(history, chosen=["redistributed", mine], failed=["L1U", "R1U"], priority={"M": 3.0})
    assert study.comparison["mine"].propellant == 0
    assert study.to_dict()["history"]["failed"] == {"L1U": None, "R1U": None}
    assert study.comparison["redistributed"].u[:, history.effectors.index("L1U")].max() == 0


@pytest.mark.slow
def test_recorded_flight_of_the_sts1_case():
    history = allocation.recorded_pitch_history()
    assert isinstance(history.effectors, Effectors)
    study = allocation.run(history, chosen=["paper", "qp", "daqp"], slow=60)
    own, paper = study.comparison["QP (own)"], study.comparison["paper logic"]
    assert own.unsolved == 0
    assert own.worst_kkt < 1e-9
    assert own.propellant == pytest.approx(paper.propellant, rel=0.05)
