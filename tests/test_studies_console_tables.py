"""Tables on narrow terminals: every cell whole, each part with the names of its rows; and what the commands share beside them."""

import json

import pytest
from matplotlib.figure import Figure

from studies import console

COLUMNS = ("method", "rms error [deg]", "largest error [deg]", "mean ± half-width", "remark")
ROWS = [
    ("equation 20 as printed", 0.0723933, 1.53e-08, "0.07699 ± 0.0072", ""),
    ("QP (lsq_linear)", 8.81e-08, 4.5, "0.2977 ± 0.013", "out of authority"),
]
CELLS = ["0.0723933", "1.53e-08", "0.07699 ± 0.0072", "8.81e-08", "4.5", "0.2977 ± 0.013", "out of authority"]


def shown(capsys, monkeypatch, width, columns=COLUMNS, rows=ROWS, title="A title"):
    monkeypatch.setenv("COLUMNS", str(width))
    console.print_table(title, columns, rows)
    return capsys.readouterr().out


@pytest.mark.parametrize(("width", "parts"), [(120, 1), (70, 2), (50, 3)])
def test_no_cell_is_broken(capsys, monkeypatch, width, parts):
    out = shown(capsys, monkeypatch, width)
    assert [cell for cell in CELLS if out.count(cell) != 1] == []
    assert out.count("┏") == parts
    assert out.count("equation 20 as printed") + out.count("QP (lsq_linear)") >= parts + 1
    assert out.count("A title") == 1
    assert max(map(len, out.splitlines())) <= width


def test_rows_that_are_blank_in_a_further_part_are_left_out_there(capsys, monkeypatch):
    last = shown(capsys, monkeypatch, 50).split("┏")[-1]
    assert "out of authority" in last
    assert "equation 20" not in last


def test_long_text_is_wrapped_between_words_and_stays_beside_its_row(capsys, monkeypatch):
    words = [f"word{i}" for i in range(40)]
    out = shown(capsys, monkeypatch, 60, ("check", "", "meaning"), [("a name of a row", "OK", " ".join(words))])
    assert out.count("┏") == 1
    assert [word for word in words if word + " " not in out] == []
    assert max(map(len, out.splitlines())) <= 60


def test_only_long_text_gives_way(capsys, monkeypatch):
    name, value = "one of the six nose-up jets", "0.07699 ± 0.0072 kg"
    out = shown(capsys, monkeypatch, 80, ("case", "value", "meaning"), [(name, value, "text " * 60)])
    assert out.count("┏") == 1
    assert name in out
    assert value in out


@pytest.mark.parametrize("width", [20, 24])
@pytest.mark.parametrize("value", ["5", "0.0723933", "-1.53e-08 kg"])
@pytest.mark.parametrize("heading", ["value", "the uncertainties"])
def test_the_first_column_folds_before_a_number_is_broken(capsys, monkeypatch, width, value, heading):
    name = "equation-20-as-printed-in-it"
    out = shown(capsys, monkeypatch, width, ("name", heading), [(name, value)])
    assert value in out
    body = out.split("┡")[1]
    assert "".join(line.split("│")[1].strip() for line in body.splitlines() if line.startswith("│")) == name
    assert max(map(len, out.splitlines())) <= width


def test_a_cell_of_many_blanks_is_a_cell(capsys, monkeypatch):
    assert "second" in shown(capsys, monkeypatch, 30, ("first", "second"), [(" " * 40, " " * 30)])


def test_nothing_is_lost_where_a_number_is_wider_than_the_terminal(capsys, monkeypatch):
    out = shown(capsys, monkeypatch, 20, ("name", "value"), [("abcdefghijkl", "0.123456789012345678")])
    cells = [[part.strip() for part in line.split("│")[1:3]] for line in out.splitlines() if line.startswith("│")]
    assert ["".join(column) for column in zip(*cells, strict=True)] == ["abcdefghijkl", "0.123456789012345678"]


def test_nothing_is_lost_where_a_word_is_wider_than_the_terminal(capsys, monkeypatch):
    out = shown(capsys, monkeypatch, 30, ("word", "period"), [("abcdefghij" * 6, 15)])
    inside = "".join(line.split("│")[1].strip() for line in out.splitlines() if line.startswith("│"))
    assert inside == "abcdefghij" * 6
    assert "15" in out


def test_empty_tables_and_single_columns(capsys, monkeypatch):
    assert shown(capsys, monkeypatch, 40, ("a heading of many words that has no room", "second"), []).count("┏") == 1
    assert "one" in shown(capsys, monkeypatch, 20, ("a heading of many words",), [("one",)])


def test_changes_of_the_command_line():
    assert console.changes(None, example="a=1") == {}
    assert console.changes([" a.b = 1=2 ", "c=", "a.b=3"], example="a=1") == {"a.b": "3", "c": ""}
    for text in ("a.b", "=3", " =3"):
        with pytest.raises(console.InputError, match=r"--set: found .*, expected key=value such as a=1"):
            console.changes([text], example="a=1")


def test_options_of_names_and_values():
    assert console.named_values("--x", None, expected="") == {}
    assert console.named_values("--x", [" a = 1=2 ", "b="], expected="") == {"a": "1=2", "b": ""}
    assert console.named_values("--x", ["a", "b=1"], expected="", bare=True) == {"a": None, "b": "1"}
    assert console.numbers("--x", ["a=1e3", "b = -2"], expected="") == {"a": 1000.0, "b": -2.0}
    for texts, message in (
        (["a"], "--x: found 'a', expected n=1"), ([" =1"], "--x: found ' =1', expected n=1"),
        (["a=1", " a =2"], "--x: a is given twice; give it once"), (["a="], "--x: found 'a=', expected a finite number"),
        (["a=inf"], "--x: found 'a=inf', expected a finite number after the ="),
    ):  # fmt: skip
        with pytest.raises(console.InputError) as caught:
            console.numbers("--x", texts, expected="n=1")
        assert message in str(caught.value)


def test_answer_is_written_whole_or_not_at_all(tmp_path, capsys):
    place = tmp_path / "new" / "folder"
    console.write_answer(place, "answer", {"x": 1}, figures=lambda: {"drawing": Figure()})
    assert json.loads((place / "answer.json").read_text(encoding="utf-8")) == {"x": 1}
    assert (place / "drawing.svg").read_text(encoding="utf-8").startswith("<svg")
    assert "wrote answer.json and figures into" in capsys.readouterr().err
    console.write_answer(place, "bare", {}, figures=dict)
    assert "wrote bare.json into" in capsys.readouterr().err

    def broken():
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        console.write_answer(tmp_path / "other", "answer", {}, figures=broken)
    console.write_answer(None, "answer", {}, figures=broken)  # without a folder nothing is drawn
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
