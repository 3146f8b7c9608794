"""What every study hands over: figures, tables, *paper | computed | why different* rows, plain data. Frozen values."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from models.checked import ModelError

if TYPE_CHECKING:  # matplotlib takes most of a second to import, and a result needs it only as a type
    from matplotlib.figure import Figure

Cell = str | int | float | bool | None
_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_REMEDY = "leave the value out or report the failure"
_MINUS, _NARROW_SPACE = "\u2212", "\u202f"


def number(value: float, *, digits: int = 4) -> str:
    """The one way in which a number is written for people.

    A rounded number keeps `digits` significant digits with their zeros; a number that needs fewer is written short (0.25, 45);
    digits before the decimal point are never rounded away and are grouped by thousands; below 0.01 and from 1e7 on
    a power of ten is used.

    Parameters
    ----------
    value : float or int
    digits : int
        Significant digits, 1 to 15.

    Returns
    -------
    str
        Such as ``"−1.500×10⁻³"``, ``"547.1"``, ``"2 720 773"``.

    Raises
    ------
    ModelError
        A value that is not a finite real number.
    """
    if not 1 <= digits <= 15:
        raise ModelError(f"number: digits must lie in 1 to 15, got {digits}")
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ModelError(f"number: expected a real number, got {value!r}; give an int or a float")
    if not math.isfinite(value):
        raise ModelError(f"number: expected a finite number, got {value}; a result that is NaN or infinite is not printed")
    if isinstance(value, (int, np.integer)):
        return _grouped(str(int(value)))
    mantissa, exponent_text = f"{float(value):.{digits - 1}e}".split("e")
    exponent = int(exponent_text)
    # 1.8 is short, and so is 3 * 0.6, which misses it by one rounding.
    short = math.isclose(float(mantissa + "e" + exponent_text), float(value), rel_tol=1e-14)
    if value != 0.0 and not -2 <= exponent < 7:
        body = _trimmed(mantissa) if short else mantissa
        return body.replace("-", _MINUS) + "×10" + str(exponent).translate(_SUPERSCRIPT)
    text = f"{float(value):.{max(digits - 1 - exponent, 0)}f}"
    return _grouped(_trimmed(text) if short else text)


def _trimmed(text: str) -> str:
    return text.rstrip("0").rstrip(".") if "." in text else text


def _grouped(text: str) -> str:
    sign = _MINUS if text.startswith("-") and float(text) != 0.0 else ""
    whole, point, fraction = text.lstrip("-").partition(".")
    if len(whole) > 4:
        whole = f"{int(whole):,}".replace(",", _NARROW_SPACE)
    return sign + whole + point + fraction


def as_plain(value: object, where: str) -> Any:
    """Copy of `value` made of dict, list, str, int, float, bool and None only, so that any JSON reader can take it.

    Parameters
    ----------
    value : object
        Nested mappings, sequences, NumPy arrays and scalars.
    where : str
        Name for messages; keys and indices are appended to it.

    Raises
    ------
    ModelError
        Another type, a key that is not a string, a NaN or an infinity: named by its place.
    """
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        bad = np.argwhere(~np.isfinite(value))
        if bad.size:
            place = "".join(f"[{i}]" for i in bad[0])
            raise ModelError(f"{where}{place}: expected a finite number, got {value[tuple(bad[0])]}; {_REMEDY}")
        return value.tolist()
    if isinstance(value, (float, np.floating)):
        if not math.isfinite(value):
            raise ModelError(f"{where}: expected a finite number, got {value}; {_REMEDY}")
        return float(value)
    if isinstance(value, (np.bool_, np.integer)):
        return value.item()
    if isinstance(value, Mapping):
        wrong = [key for key in value if not isinstance(key, str)]
        if wrong:
            raise ModelError(f"{where}: key {wrong[0]!r} is not a string; JSON has string keys only")
        return {key: as_plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise ModelError(f"{where}: {type(value).__name__} cannot be written as JSON; give numbers, text, lists, arrays or mappings")


def _check_name(what: str, name: object) -> None:
    # Names become file names and HTML anchors; without a hyphen of their own they can be joined by one and stay unique.
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ModelError(f"{what}: name {name!r} must be lower-case letters, digits and underscores, starting with a letter, at most 64")


def _check_texts(what: str, **texts: object) -> None:
    for name, text in texts.items():
        if not isinstance(text, str):
            raise ModelError(f"{what}: {name} must be text, got {text!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """One row of *paper | computed | why different*.

    Attributes
    ----------
    quantity : str
        What is compared.
    paper : str, float or None
        The printed value; text where the print gives no single number ("about 0.6"); None where the paper gives none.
    computed : float
        The value of this study, in `unit`.
    unit : str
        Unit of both; "1" or "" when dimensionless.
    why : str
        Why the two differ, or why they need not agree.
    tolerance : float or None
        Largest accepted ``|computed - paper|`` relative to ``|paper|`` (absolute where the paper prints zero); None: not judged.
    """

    quantity: str
    paper: str | float | None
    computed: float
    unit: str = "1"
    why: str = ""
    tolerance: float | None = None

    def __post_init__(self) -> None:
        what = f"Comparison {self.quantity!r}"
        _check_texts(what, quantity=self.quantity, unit=self.unit, why=self.why)
        number(self.computed)
        if self.paper is not None and not isinstance(self.paper, str):
            number(self.paper)
        if self.tolerance is not None:
            if self.paper is None or isinstance(self.paper, str):
                raise ModelError(f"{what}: tolerance {self.tolerance} needs a numeric printed value, got {self.paper!r}; leave it None")
            if not (math.isfinite(self.tolerance) and self.tolerance > 0):
                raise ModelError(f"{what}: tolerance must be finite and > 0, got {self.tolerance}")

    @property
    def difference(self) -> float | None:
        """Relative difference ``(computed - paper)/paper``: positive where the magnitude is larger.

        None without a printed number or with a printed zero.
        """
        if self.paper is None or isinstance(self.paper, str) or self.paper == 0:
            return None
        return (self.computed - self.paper) / self.paper

    @property
    def met(self) -> bool | None:
        """True or False where a tolerance is given, else None."""
        if self.tolerance is None or self.paper is None or isinstance(self.paper, str):
            return None
        return abs(self.computed - self.paper) <= self.tolerance * (abs(self.paper) if self.paper != 0 else 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table: column headings (with units), rows of text, numbers, booleans or None, and a caption."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""

    def __post_init__(self) -> None:
        what = f"Table {self.title!r}"
        columns = tuple(self.columns)
        _check_texts(what, title=self.title, caption=self.caption, **{f"column {i}": c for i, c in enumerate(columns)})
        rows = []
        for i, row in enumerate(self.rows):
            cells = tuple(as_plain(cell, f"{what}: row {i}, column {j}") for j, cell in enumerate(row))
            if len(cells) != len(columns):
                raise ModelError(f"{what}: row {i} has {len(cells)} cells, expected {len(columns)} for [{', '.join(columns)}]")
            nested = next((j for j, cell in enumerate(cells) if isinstance(cell, (list, dict))), None)
            if nested is not None:
                raise ModelError(f"{what}: row {i}, column {nested} holds {cells[nested]!r}; a cell is one text or one number")
            rows.append(cells)
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "rows", tuple(rows))


@dataclass(frozen=True, slots=True, eq=False)
class FigureItem:
    """A figure with its file name (letters, digits, underscores), title and caption."""

    name: str
    title: str
    caption: str
    figure: Figure

    def __post_init__(self) -> None:
        _check_name("FigureItem", self.name)
        _check_texts(f"FigureItem {self.name}", title=self.title, caption=self.caption)
        if not hasattr(self.figure, "savefig"):
            raise ModelError(f"FigureItem {self.name}: expected a matplotlib Figure, got {type(self.figure).__name__}")


@dataclass(frozen=True, slots=True, eq=False)
class Headline:
    """One number for the head of the report: label, finite value, unit, a few words beside it, significant digits."""

    label: str
    value: float
    unit: str = ""
    note: str = ""
    digits: int = 4

    def __post_init__(self) -> None:
        _check_texts(f"Headline {self.label!r}", label=self.label, unit=self.unit, note=self.note)
        number(self.value, digits=self.digits)


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """Everything that one study shows.

    Attributes
    ----------
    name : str
        File name of its data: letters, digits, underscores.
    title, lead : str
        Heading and opening paragraph.
    figures, tables, comparisons : tuples of FigureItem, Table, Comparison
        In the order of the report; figure names are unique.
    data : dict
        JSON-able; NumPy arrays are taken as lists. Written to ``data/<name>.json``.
    failed : tuple of (set, case number, reason)
        Cases that gave no result; the results of the others stand.
    headlines : tuple of Headline
        The few numbers worth a card at the head of the report.
    """

    name: str
    title: str
    lead: str
    figures: Sequence[FigureItem] = ()
    tables: Sequence[Table] = ()
    comparisons: Sequence[Comparison] = ()
    data: dict[str, Any] = field(default_factory=dict)
    failed: Sequence[tuple[str, int, str]] = ()
    headlines: Sequence[Headline] = ()

    def __post_init__(self) -> None:
        _check_name("StudyResult", self.name)
        what = f"StudyResult {self.name}"
        _check_texts(what, title=self.title, lead=self.lead)
        kinds = (("figures", FigureItem), ("tables", Table), ("comparisons", Comparison), ("headlines", Headline))
        for attribute, kind in kinds:
            items = tuple(getattr(self, attribute))
            wrong = next((item for item in items if not isinstance(item, kind)), None)
            if wrong is not None:
                raise ModelError(f"{what}: {attribute} must hold {kind.__name__} values, got {type(wrong).__name__}")
            object.__setattr__(self, attribute, items)
        names = [item.name for item in self.figures]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ModelError(f"{what}: two figures are named {twice!r}; give each its own name")
        if not isinstance(self.data, Mapping):
            raise ModelError(f"{what}: data must be a dict, got {type(self.data).__name__}")
        object.__setattr__(self, "data", as_plain(self.data, f"{what}: data"))
        failed = []
        for entry in self.failed:
            if len(entry) != 3:
                raise ModelError(f"{what}: a failed case is (set, case number, reason), got {entry!r}")
            failed.append((str(entry[0]), int(entry[1]), str(entry[2])))
        object.__setattr__(self, "failed", tuple(failed))
