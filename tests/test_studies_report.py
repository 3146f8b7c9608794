"""The report: complete, self-contained, escaped, the same bytes twice, and never half-written."""

import json
import math
import platform
import re
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

import models
from studies import all_studies, figures, provenance
from studies.report import write_report
from studies.result import Comparison, FigureItem, Headline, StudyResult, Table, as_plain, number

HOSTILE = "<script>alert('x')</script>"
VOID = {"meta", "br", "hr", "img", "input", "link"}


class Page(HTMLParser):
    """Tags, ids, references and visible text of a page; every tag is closed in order."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.ids, self.references, self.words = [], [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "srcset", "data", "action"):
                self.references.append(value)
            self.references += re.findall(r"url\(([^)]*)\)", value or "")

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> without a start"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def having(self, tag, **wanted):
        return [a for t, a in self.tags if t == tag and all(wanted[k] in (a.get(k) or "").split() for k in wanted)]

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def drawing(slope=1.0, **size):
    with figures.style():
        figure, axes = figures.new_figure(**size)
        axes[0, 0].plot([0.0, 1.0, 2.0], [0.0, slope, 3.0], label="--!><b>line</b>")
        axes[0, 0].fill_between([0.0, 2.0], [0.0, 1.0], hatch="//")
        axes[0, 0].legend()
    return figure


def study(name="gains", **changes):
    fields = {
        "title": f"Gains & more {HOSTILE}",
        "lead": "One paragraph.",
        "figures": (
            FigureItem("flight", f"Flight {HOSTILE}", "Caption one.", drawing()),
            FigureItem("miss", "Miss", "Caption two.", drawing(2.0, width_mm=84.0)),
        ),
        "tables": (Table("Closed loop", ["Law", "rms [km]", "Finite"], [(HOSTILE, 0.24, True), ("none", None, False)], "A caption."),),
        "comparisons": (
            Comparison("K1", -0.62, -0.6213, "1", "", 0.03),
            Comparison("K4", -7.5e-4, -8.02e-4, "s/m", "The end of the flight differs.", 0.03),
            Comparison("claim", "stated", 0.83, "1", "Not confirmed."),
        ),
        "data": {"t_s": np.linspace(0.0, 1.0, 3), "K": {"K1": [1.5, np.float64(2.5)]}},
        "failed": (("large", 17, f"left the domain {HOSTILE}"),),
        "headlines": (Headline("Peak axial load", 3.3145, "g", "at 402 s", 5),),
    }
    return StudyResult(name, **(fields | changes))


def write(out, *studies, yaml="name: plain\n"):
    return write_report(studies or (study(),), out, scenario_yaml=yaml, provenance={"python": "3.11", "seed": 7, "more": {"a_b": [1, 2]}})


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "out"
    return write(out, study(), study("other"), yaml=f"name: {HOSTILE}\n</pre></details>\n")


@pytest.fixture(scope="module")
def page(report):
    return Page(report.read_text(encoding="utf-8"))


def test_page_is_well_formed_with_unique_ids_and_live_anchors(page):
    assert page.open == []
    assert len(page.ids) == len(set(page.ids)) > 50
    anchors = [r for r in page.references if r.startswith("#")]
    assert len(anchors) > 50
    assert {a[1:] for a in anchors} <= set(page.ids)


def test_page_loads_nothing_and_links_only_to_files_beside_it(page, report):
    outside = [r for r in page.references if not r.startswith("#")]
    assert outside
    for reference in outside:
        assert (report.parent / reference).is_file(), reference
    assert not [t for t, _ in page.tags if t in ("script", "link", "img", "iframe", "object", "base")]
    source = report.read_text(encoding="utf-8")
    assert not re.search(r"@import|@font-face|url\(\s*['\"]?(?!#)", source)
    assert "default-src 'none'" in page.having("meta", **{"http-equiv": "Content-Security-Policy"})[0]["content"]


def test_hostile_text_is_shown_and_never_run(page, report):
    assert page.text.count(HOSTILE) >= 8
    source = report.read_text(encoding="utf-8")
    assert "<script" not in source
    assert "<!--" not in source
    assert "name: &lt;script&gt;" in source
    assert len(page.having("pre")) == len(page.having("details")) == 1


def test_figures_tables_and_failures_are_all_there_and_numbered(page):
    assert len(page.having("svg")) == len(page.having("figure")) == 4
    assert len(page.having("figure", **{"class": "half"})) == 2
    for i in range(1, 5):
        assert f"Figure {i}: " in page.text
        assert f"Table {i}: " in page.text
    assert "Caption two." in page.text
    assert "1 failed case" in page.text
    assert "3.3145 g at 402 s" in page.text
    assert "more: a b" in page.text


def test_missed_printed_values_are_marked_and_counted(page):
    assert len(page.having("tr", **{"class": "missed"})) == 2
    assert len(page.having("span", **{"class": "missed"})) == 2
    assert len(page.having("span", **{"class": "met"})) == 2
    assert "✗ not met, ±3 %" in page.text
    assert "2 of 4" in page.text
    assert "−0.62 −0.6213" in page.text
    assert "−7.5×10⁻⁴ −8.02×10⁻⁴ s/m +6.9 %" in page.text


def test_page_is_made_for_paper_too(report):
    source = report.read_text(encoding="utf-8")
    printed = source[source.index("@media print") :]
    assert "size: A4" in source
    assert re.search(r"figure \{[^}]*break-inside: avoid", printed)
    assert re.search(r"nav, \.files \{ display: none", printed)


def test_files_beside_the_page(report):
    out = report.parent
    assert {entry.name for entry in out.iterdir()} == {"index.html", "figures", "data", "scenario.yaml", "provenance.json"}
    names = {entry.name for entry in (out / "figures").iterdir()}
    assert names == {f"{s}-{f}.{kind}" for s in ("gains", "other") for f in ("flight", "miss") for kind in ("svg", "png")}
    assert (out / "figures" / "gains-miss.png").read_bytes().startswith(b"\x89PNG")
    data = json.loads((out / "data" / "gains.json").read_text(encoding="utf-8"))
    assert data["data"] == {"t_s": [0.0, 0.5, 1.0], "K": {"K1": [1.5, 2.5]}}
    assert data["failed"][0]["case"] == 17
    assert [c["met"] for c in data["comparisons"]] == [True, False, None]
    assert json.loads((out / "provenance.json").read_text(encoding="utf-8"))["seed"] == 7


def test_the_same_studies_give_the_same_bytes(tmp_path):
    first, second = write(tmp_path / "a").parent, write(tmp_path / "b").parent
    for path in sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file()):
        assert (first / path).read_bytes() == (second / path).read_bytes(), path


class Broken(Figure):
    def savefig(self, *args, **kwargs):
        raise KeyboardInterrupt


def test_a_failure_on_the_way_leaves_the_older_report_whole(tmp_path):
    out = tmp_path / "out"
    page = write(out)
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    broken = study("later", figures=(FigureItem("bad", "Bad", "", Broken()),))
    with pytest.raises(KeyboardInterrupt):
        write(out, study(title="New", figures=(FigureItem("flight", "Flight", "", drawing(9.0)),)), broken)
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    write(out, study(title="New title"))
    assert "New title" in page.read_text(encoding="utf-8")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_folder_with_other_files_is_refused_and_kept(tmp_path):
    (tmp_path / "index.html").write_text("my page", encoding="utf-8")
    with pytest.raises(models.ModelError, match=r"'index.html', which is not part of a report"):
        write(tmp_path)
    assert (tmp_path / "index.html").read_text(encoding="utf-8") == "my page"
    out = tmp_path / "out"
    write(out)
    (out / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(models.ModelError, match=r"'thesis.tex'"):
        write(out)
    assert (out / "thesis.tex").exists()


def test_no_study_and_two_of_one_name_are_refused(tmp_path):
    with pytest.raises(models.ModelError, match="at least one"):
        write_report((), tmp_path / "out", scenario_yaml="", provenance={})
    with pytest.raises(models.ModelError, match="two studies are named 'gains'"):
        write(tmp_path / "out", study(), study())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.25, 4, "0.25"),
        (45.0, 4, "45"),
        (3 * 0.6, 4, "1.8"),
        (-0.62129, 4, "−0.6213"),
        (547.0639, 4, "547.1"),
        (547.0639, 6, "547.064"),
        (99.9996, 4, "100.0"),
        (-1.5e-3, 4, "−1.5×10⁻³"),
        (9.9999e-3, 3, "0.0100"),
        (-5.17111e-6, 4, "−5.171×10⁻⁶"),
        (2720772.63, 4, "2\u202f720\u202f773"),
        (6.02214e23, 3, "6.02×10²³"),
        (0.0, 4, "0"),
        (-0.0, 4, "0"),
        (7800, 4, "7800"),
        (-12345, 4, "−12\u202f345"),
        (np.float64(1.0), 4, "1"),
        (np.int64(500), 4, "500"),
    ],
)
def test_number(value, digits, text):
    assert number(value, digits=digits) == text


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1", None, 1j])
def test_number_refuses_what_is_not_a_finite_real(value):
    with pytest.raises(models.ModelError, match="number: expected"):
        number(value)


def test_values_that_are_not_finite_are_refused_by_their_place():
    with pytest.raises(models.ModelError, match=r"StudyResult gains: data\.K\.K1\[1\]: expected a finite number, got nan"):
        study(data={"K": {"K1": np.array([1.0, math.nan])}})
    with pytest.raises(models.ModelError, match=r"Table 'T': row 1, column 0: expected a finite number, got inf"):
        Table("T", ["a"], [[1.0], [math.inf]])
    with pytest.raises(models.ModelError, match="got nan"):
        Comparison("K", 1.0, math.nan)
    with pytest.raises(models.ModelError, match="object cannot be written as JSON"):
        as_plain({"a": [object()]}, "x")


def test_result_values_check_their_fields():
    with pytest.raises(models.ModelError, match="row 0 has 2 cells, expected 1"):
        Table("T", ["a"], [[1.0, 2.0]])
    with pytest.raises(models.ModelError, match="two figures are named 'flight'"):
        study(figures=study().figures[:1] * 2)
    for name in ("../up", "A", "a-b", "", "a" * 65):
        with pytest.raises(models.ModelError, match="must be lower-case letters"):
            study(name)
    with pytest.raises(models.ModelError, match="needs a numeric printed value"):
        Comparison("K", "about 1", 1.0, "1", "", 0.1)
    with pytest.raises(models.ModelError, match="tables must hold Table values"):
        study(tables=("text",))


def test_met_is_relative_to_the_printed_value_and_absolute_at_zero():
    assert Comparison("a", -2.0, -2.05, "1", "", 0.03).met is True
    assert Comparison("a", -2.0, -2.07, "1", "", 0.03).met is False
    assert Comparison("a", 0.0, 0.02, "1", "", 0.03).met is True
    assert Comparison("a", None, 0.02).met is None
    assert Comparison("a", -2.0, -2.1).difference == pytest.approx(0.05, rel=1e-12)


def test_svg_ids_are_prefixed_and_drawings_do_not_change_global_settings():
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    one, two = figures.to_svg(drawing()), figures.to_svg(drawing(2.0))
    assert dict(mpl.rcParams) == before
    ids = [set(re.findall(r'\sid="([^"]*)"', svg)) for svg in (one, two)]
    assert len(ids[0]) > 20
    assert not ids[0] & ids[1]
    assert all(i.startswith("z-") for i in re.findall(r'\sid="([^"]*)"', figures.to_svg(drawing(), prefix="z-")))
    assert "<text" not in one
    assert "<style" not in one
    with pytest.raises(models.ModelError, match="prefix"):
        figures.to_svg(drawing(), prefix='"><b')


def test_small_multiples_are_lettered_and_leave_no_empty_frame():
    figure, panels = figures.small_multiples(["One", "Two", "Three"], sharex=True)
    assert [panel.get_title(loc="left") for panel in panels] == [
        rf"$\mathbf{{{c}}}$   {t}" for c, t in zip("abc", ["One", "Two", "Three"], strict=True)
    ]
    assert sum(axes.get_visible() for axes in figure.axes) == 3
    assert panels[1].xaxis.get_tick_params()["labelbottom"]
    assert figures.width_mm(figure) == pytest.approx(170.0, rel=1e-12)


def test_figures_do_not_need_pyplot():
    code = "import sys, studies.figures as f; f.to_svg(f.new_figure()[0]); sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_provenance_names_versions_and_no_person_machine_or_folder(monkeypatch):
    for variable in ("USER", "LOGNAME", "HOME", "HOSTNAME"):
        monkeypatch.setenv(variable, "/home/ada-lovelace")
    monkeypatch.setattr(platform, "node", lambda: "ada-laptop")
    monkeypatch.setattr(platform, "release", lambda: "6.1.0-ada")
    monkeypatch.setattr(platform, "platform", lambda: "Linux-6.1.0-ada")
    facts = provenance.collect({"vehicle": {"lift_to_drag": 0.25}}, 7)
    assert {"package", "date_utc", "python", "casadi", "numpy", "scipy", "platform", "cpu_count", "seed"} <= set(facts)
    assert facts["numpy"] == np.__version__
    assert not re.search(r"ada-|-ada|[/\\]", json.dumps(facts))
    other = provenance.collect({"vehicle": {"lift_to_drag": 0.3}}, 7)
    assert other["scenario_sha256"] != facts["scenario_sha256"]
    with pytest.raises(models.ModelError, match="seed"):
        provenance.collect({}, 1.5)
    with pytest.raises(models.ModelError, match="cannot be written as JSON"):
        provenance.collect({"a": math.nan}, 1)


def test_run_all_hands_the_order_to_every_study(monkeypatch):
    seen = []

    def call(module, order):
        seen.append((module.__name__, order.scenario, order.cases, order.full))
        return study()

    monkeypatch.setattr(all_studies, "STUDIES", (("json", call), ("math", call)))
    assert [r.name for r in all_studies.run_all("s", cases=20)] == ["gains", "gains"]
    all_studies.run_all("s", cases=20, full=True)
    assert seen == [("json", "s", 20, False), ("math", "s", 20, False), ("json", "s", 200, True), ("math", "s", 200, True)]
    monkeypatch.setattr(all_studies, "STUDIES", (("json", lambda module, order: None),))
    with pytest.raises(models.ModelError, match="json: expected a StudyResult, got NoneType"):
        all_studies.run_all("s")
    with pytest.raises(models.ModelError, match="cases must be"):
        all_studies.run_all("s", cases=0)
