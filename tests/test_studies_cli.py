"""The command line: exit codes for every way to end, one JSON object on stdout, files whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import pytest
from conftest import Run
from matplotlib.figure import Figure

from models.checked import ModelError
from studies import console, doctor
from studies.scenario import Scenario

ROOT = Path(__file__).resolve().parent.parent


class FakeStudy:
    """Stands for a finished gain study."""

    remarks = ("a remark",)
    closed_loop: ClassVar[dict[str, Any]] = {}

    def __init__(self, failed: Sequence[tuple[str, int, str]] = (), value: float = 547.064) -> None:
        self.failed = list(failed)
        self.value = value

    def to_dict(self) -> dict[str, Any]:
        keys = ("t_f_s", "range_m", "peak_axial_g", "peak_load_g", "peak_time_s")
        return {"reference": dict.fromkeys(keys, self.value), "K": {"K1": [1.0]}}

    def figures(self) -> dict[str, Figure]:
        return {"flight": Figure(), "gains": Figure()}

    def summary(self) -> list[tuple[str, float, str]]:
        return [("flight time [bold]", self.value, "s")]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Scenario, dict[str, Any]]]:
    """Replace the synthesis by a fake and note what it is asked."""
    calls: list[tuple[Scenario, dict[str, Any]]] = []

    def fake(self: Scenario, **options: Any) -> FakeStudy:
        calls.append((self, options))
        print("noise of a library")
        return FakeStudy()

    monkeypatch.setattr(Scenario, "run", fake)
    return calls


def ends_with(monkeypatch: pytest.MonkeyPatch, outcome: BaseException | FakeStudy) -> None:
    def fake(self: Scenario, **options: Any) -> FakeStudy:
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(Scenario, "run", fake)


def test_gains_json_is_one_object_and_nothing_else(run: Run, asked: list[Any]) -> None:
    code, out, err = run("gains", "--json", "--dispersions", 7, "--at", "0, 50,1e2", "--set", "vehicle.lift_to_drag=0.3")
    assert code == 0
    assert json.loads(out)["reference"]["t_f_s"] == 547.064
    assert "noise" in err
    ((scenario, options),) = asked
    assert scenario.vehicle.lift_to_drag == 0.3
    assert (options["dispersions"], options["at"]) == (7, [0.0, 50.0, 100.0])


def test_gains_table_for_people(run: Run, asked: list[Any]) -> None:
    code, out, _ = run("gains")
    assert code == 0
    assert "547.064" in out
    assert "[bold]" in out  # shown, not read as markup
    assert "noise" not in out


def test_last_change_wins_over_the_file(run: Run, asked: list[Any], tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("reference: {bank_deg: 50}\nvehicle: {name: X}\n")
    assert run("gains", "s.yaml", "--set", "reference.bank_deg=55", "--set", "reference.bank_deg = 60", "--json")[0] == 0
    assert (asked[0][0].reference.bank_deg, asked[0][0].vehicle.name) == (60.0, "X")


@pytest.mark.parametrize("command", ["gains", "study", "demo", "doctor", "schema"])
def test_every_command_prints_the_scenario(run: Run, command: str) -> None:
    code, out, err = run(command, "--print-scenario", "--set", "weights.terminal=[0.2, 250, 200, 500]")
    assert (code, err) == (0, "")
    assert Scenario.parse(out).weights.terminal == (0.2, 250.0, 200.0, 500.0)
    assert json.loads(run(command, "--print-scenario", "--json")[1]) == Scenario.default().to_dict()


@pytest.mark.parametrize("command", ["gains", "study", "demo", "doctor", "schema"])
@pytest.mark.parametrize("form", [[], ["--json"]])
def test_every_command_refuses_wrong_input(run: Run, asked: list[Any], tmp_path: Path, command: str, form: list[str]) -> None:
    (tmp_path / "bad.yaml").write_text("vehicle:\n  lift_to_drag: x\n")
    (tmp_path / "file").write_text("")
    cases = [
        (["bad.yaml"], "bad.yaml:2: vehicle.lift_to_drag: found 'x', expected a number from 0.01 to 4"),
        (["none.yaml"], "none.yaml: no such file"),
        (["."], "is a folder"),
        (["--set", "vehicle.lift_to_dra=1"], "--set: unknown key 'vehicle.lift_to_dra'; did you mean 'vehicle.lift_to_drag'?"),
        (["--set", "vehicle.lift_to_drag"], "expected key=value"),
        (["--set", "reference.path_angle_deg=nan"], "reference.path_angle_deg: found 'nan'"),
        (["--out", "file"], "is a file, expected a folder"),
        (["--out", "file/below"], "lies below the file"),
        (["--nonsense"], "No such option"),
    ]
    for arguments, part in cases:
        code, out, err = run(command, *arguments, *form)
        assert (code, out) == (2, ""), arguments
        assert part in " ".join(err.replace("│", " ").split()), (arguments, err)
        assert "Traceback" not in err
    assert asked == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.yaml", "file"]


@pytest.mark.parametrize("text", ["", "x", "1,,2", "-1", "nan", "inf", "1;2", "0,50,"])
def test_malformed_times(run: Run, asked: list[Any], text: str) -> None:
    code, out, err = run("gains", "--json", "--at", text)
    assert (code, out, asked) == (2, "", [])
    assert "--at: found" in err


@pytest.mark.parametrize("arguments", [["--dispersions", "-1"], ["--dispersions", "x"], ["a", "b"]])
def test_malformed_options(run: Run, arguments: list[str]) -> None:
    assert run("gains", *arguments)[:2] == (2, "")


def test_misspelt_command(run: Run) -> None:
    code, out, err = run("gain")
    assert (code, out) == (2, "")
    assert "Did you mean 'gains'?" in err


@pytest.mark.parametrize(
    ("end", "code", "part"),
    [
        (ModelError("at: 600 s lies outside [0, 547.064] s"), 2, "at: 600 s lies outside"),
        (PermissionError(errno.EACCES, "Permission denied", "/some/place"), 4, "/some/place: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device"), 4, "No space left on device"),
        (ModuleNotFoundError("No module named 'part'"), 4, "reentry doctor"),
        (MemoryError(), 4, "not enough memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 0, ""),
        (ZeroDivisionError("division by zero"), 4, "internal error: ZeroDivisionError: division by zero"),
    ],
)
def test_exit_codes(run: Run, monkeypatch: pytest.MonkeyPatch, end: BaseException, code: int, part: str, tmp_path: Path) -> None:
    monkeypatch.delenv("REENTRY_DEBUG", raising=False)
    monkeypatch.setattr(console, "_drop_stdout", lambda: None)
    ends_with(monkeypatch, end)
    for command in (["gains", "--json", "--out", "results"], ["demo"]):
        found, out, err = run(*command)
        assert (found, out) == (code, "")
        assert part in err
        assert "Traceback" not in err
        assert list(tmp_path.iterdir()) == []


def test_internal_error_can_be_traced(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REENTRY_DEBUG", "1")
    ends_with(monkeypatch, ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        run("gains")


def test_failed_cases_are_named_and_the_others_stand(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    ends_with(monkeypatch, FakeStudy([("large", number, "skips out") for number in range(30)]))
    code, out, err = run("gains", "--json")
    assert code == 3
    assert json.loads(out)["reference"]
    assert "case 17 of large: skips out" in err
    assert "30 case(s) failed" in err


def test_nan_is_never_printed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    ends_with(monkeypatch, FakeStudy(value=float("nan")))
    code, out, err = run("gains", "--json")
    assert (code, out) == (4, "")
    assert "internal error" in err


def test_gains_out_keeps_other_files(run: Run, asked: list[Any], tmp_path: Path) -> None:
    place = tmp_path / "a" / "results"
    assert run("gains", "--out", place, "--set", "vehicle.name=Y")[0] == 0
    assert sorted(p.name for p in place.iterdir()) == ["flight.svg", "gains.json", "gains.svg", "scenario.yaml"]
    assert Scenario.load(place / "scenario.yaml").vehicle.name == "Y"
    assert json.loads((place / "gains.json").read_text()) == FakeStudy().to_dict()
    (place / "notes.txt").write_text("mine")
    assert run("gains", "--out", place)[0] == 0
    assert Scenario.load(place / "scenario.yaml").vehicle.name == "N1"
    assert (place / "notes.txt").read_text() == "mine"
    assert len(list(place.iterdir())) == 5


def test_demo_draws_a_figure(run: Run, asked: list[Any], tmp_path: Path) -> None:
    code, out, _ = run("demo")
    assert code == 0
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert "demo.png" in out
    assert out.count("547.064") == 5
    code, out, _ = run("demo", "--json", "--out", "here")
    assert json.loads(out)["figure"] == "here/demo.png"
    assert (tmp_path / "here" / "demo.png").is_file()


def test_study_hands_over_to_the_report(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Any] = []
    result = types.SimpleNamespace(name="gains", data={"a": 1}, failed=[("small", 3, "why")])

    def run_all(scenario: Scenario, *, full: bool, cases: int, progress: object) -> list[Any]:
        asked.append((scenario.vehicle.name, full, cases))
        return [result]

    def write_report(studies: list[Any], out: Path, *, scenario_yaml: str, provenance: dict[str, Any]) -> Path:
        asked.append((studies, out, Scenario.parse(scenario_yaml).vehicle.name, provenance))
        return out / "index.html"

    modules = {
        "all_studies": {"run_all": run_all},
        "report": {"write_report": write_report},
        "provenance": {"collect": lambda s, seed: {"seed": seed}},
    }
    for name, content in modules.items():
        monkeypatch.setitem(sys.modules, f"studies.{name}", types.SimpleNamespace(**content))
    code, out, err = run("study", "--full", "--cases", 5, "--set", "vehicle.name=Z", "--json")
    assert code == 3
    assert json.loads(out) == {"report": "out/report/index.html", "studies": {"gains": {"a": 1}}}
    assert "case 3 of small: why" in err
    assert asked == [("Z", True, 5), ([result], Path("out/report"), "Z", {"seed": 20000503})]


def test_doctor_reports_and_judges(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: [doctor.Check("a", True, "well"), doctor.Check("b", False, "why it fails")])
    code, out, err = run("doctor", "--set", "vehicle.lift_to_drag=0.3")
    assert code == 4
    assert "why it fails" in out
    assert "not sound: b" in err
    code, out, _ = run("doctor", "--json", "--out", "d")
    assert code == 4
    assert [c["ok"] for c in json.loads(out)["checks"]] == [True, False]
    assert json.loads((tmp_path / "d" / "doctor.json").read_text())["ok"] is False
    monkeypatch.setattr(doctor, "examine", lambda: [doctor.Check("a", True, "well")])
    assert run("doctor")[0] == 0


def test_doctor_names_what_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> list[doctor.Check]:
        raise RuntimeError("no such symbol\nsecond line")

    monkeypatch.setattr(doctor, "_study", broken)
    monkeypatch.setattr(doctor, "_density", lambda: [doctor.Check("d", *doctor._compare(1.01, 1.0, 1e-3, "kg/m3", "table"))])
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    checks = {check.name: check for check in doctor.examine()}
    assert not checks["reference N1"].ok
    assert "RuntimeError: no such symbol" in checks["reference N1"].detail
    assert not checks["d"].ok
    assert checks["C compiler"].ok
    assert "interpreter" in checks["C compiler"].detail
    assert checks["CasADi derivative"].ok


def test_schema(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("schema", "--out", "s")
    assert code == 0
    assert json.loads(out) == Scenario.json_schema()
    assert json.loads((tmp_path / "s" / "scenario.schema.json").read_text()) == Scenario.json_schema()


def test_version(run: Run) -> None:
    assert run("--version")[:2] == (0, f"reentry {doctor.version()}\n")


def shell(command: str, **options: Any) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "default"}
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", command.replace("reentry", f"{sys.executable} -m studies.cli")],
        capture_output=True, text=True, env=environment, timeout=60, check=False, **options,
    )  # fmt: skip


def test_processes_end_with_the_promised_codes(tmp_path: Path) -> None:
    done = shell("reentry schema | head -c 20", cwd=tmp_path)
    assert (done.stdout[:1], done.stderr) == ("{", "")
    refused = shell("reentry gains --json --set vehicle.lift_to_dra=1", cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == "--set: unknown key 'vehicle.lift_to_dra'; did you mean 'vehicle.lift_to_drag'?\n"
    if Path("/dev/full").exists():
        full = shell("reentry schema > /dev/full", cwd=tmp_path)
        assert full.returncode == 4
        assert "No space left on device" in full.stderr
    ascii_only = shell("PYTHONIOENCODING=ascii reentry gains --print-scenario --set 'vehicle.name=Schäfer'", cwd=tmp_path)
    assert ascii_only.returncode == 0


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from studies import cli; code = cli.main(['--help']);"
        "print(code, [m for m in ('casadi', 'numpy', 'scipy', 'matplotlib', 'pydantic', 'ruamel.yaml', 'xarray') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60, check=True)
    assert done.stdout.endswith("0 []\n")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_leave_nothing_half_written(tmp_path: Path, number: int) -> None:
    script = tmp_path / "slow.py"
    script.write_text(
        "import sys, time\n"
        "from studies import cli\n"
        "from studies.scenario import Scenario\n"
        "class Slow:\n"
        "    failed = ()\n"
        "    def to_dict(self): return {'a': 1}\n"
        "    def figures(self):\n"
        "        print('ready', file=sys.stderr, flush=True)\n"
        "        time.sleep(30)\n"
        "Scenario.run = lambda self, **options: Slow()\n"
        "sys.exit(cli.main(['gains', '--json', '--out', 'results/run']))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "ready\n"
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out) == (130, "")
    assert "interrupted" in err
    assert "Traceback" not in err
    assert [p.name for p in tmp_path.iterdir()] == ["slow.py"]


def test_doctor_is_content_with_this_installation() -> None:
    failing = [(check.name, check.detail) for check in doctor.examine() if not check.ok]
    assert failing == []
