"""Settings of the documentation (Sphinx).  Nothing here asks the network: no remote inventories, no remote scripts."""

import json
import os
import re
import shutil
import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent

project = "Reentry workbench"
author = "The contributors of the reentry workbench"
copyright = author
version = release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
highlight_language = "none"  # what is Python says so; the rest is shell and output

# Notebooks live in notebooks/ without output; the build runs copies of them.
nb_execution_mode = "auto"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "Expressions", "Method")}
python_use_unqualified_type_names = True
napoleon_google_docstring = False
napoleon_use_ivar = True  # fields of a dataclass are described once, in the class
napoleon_custom_sections = ["Source", "Sources", "Limits", "Assumptions", "Formula", "Method"]

html_theme = "pydata_sphinx_theme"
html_title = f"{project} {version}"
html_static_path = ["_static"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "header_links_before_dropdown": 7,
    "logo": {"text": project},
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],  # the sign alone: with a field the header takes two rows
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"*": [], "tutorials/*": ["sidebar-nav-bs"]}  # only the tutorials have pages below them

_MARKUP = re.compile(r"(``.*?``|:[\w:]+:`.*?`|`.*?`_?|https?://\S+|(?<![*\w])\*\*?\w+(?= *[:,]| *$))")
_SECTION = re.compile(r"(?:Attributes|Parameters|Other Parameters|Returns)$")
_TOGETHER = re.compile(r"(?P<names>\*{0,2}\w+(?:, \*{0,2}\w+)+) : (?P<kind>.+)")
_ALIAS = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
_LONG = re.compile(r"~?\b(?:typing|numpy|collections\.abc|casadi\.casadi)\.")
_FLOATS = re.compile(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[float64\]\]")
_SHAPE = re.compile(r"\([^()]*\)")


def copy_notebooks() -> None:
    """Copies beside the tutorials' index, the old ones removed."""
    target = HERE / "tutorials"
    for old in target.glob("*.ipynb"):
        old.unlink()
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        shutil.copyfile(notebook, target / notebook.name)


def use_this_interpreter(folder):
    """A kernel ``python3`` that is this interpreter, and says nothing of how it talks to the build on this machine."""
    spec = {
        "argv": [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}", "--log-level=ERROR"],
        "display_name": "Python 3",
        "language": "python",
    }
    place = folder / "jupyter" / "kernels" / "python3"
    place.mkdir(parents=True, exist_ok=True)
    (place / "kernel.json").write_text(json.dumps(spec), encoding="utf-8")
    known = os.environ.get("JUPYTER_PATH")
    os.environ["JUPYTER_PATH"] = os.pathsep.join([str(folder / "jupyter"), *([known] if known else [])])


def short_types(app, what, name, obj, options, signature, return_annotation):
    """Aliases inside other types by their name; an array of floats is an `Array`."""
    # what the parser of signatures cannot read it prints as it stands
    texts = (signature.replace("<factory>", "...") if signature else signature, return_annotation)
    return tuple(_FLOATS.sub("Array", _ALIAS.sub(r"\1", _LONG.sub("", text))) if text else text for text in texts)


def each_its_kind(names, kind):
    """The types of fields that are documented together: 'ndarray, shapes (N,), (N, 2)' gives each its shape."""
    shapes = _SHAPE.findall(kind)
    if "shapes " in kind and len(shapes) == len(names):
        before, after = kind.split("shapes ")[0], kind[kind.rindex(shapes[-1]) + len(shapes[-1]) :]
        return [f"{before}shape {shape}{after}" for shape in shapes]
    if kind.startswith("tuples of ") and len(items := kind.removeprefix("tuples of ").split(", ")) == len(names):
        return [f"tuple of {item}" for item in items]
    return [kind] * len(names)


def one_field_a_line(app, what, name, obj, options, lines):
    """'V, gamma : float' as one field for each name, which napoleon cannot do; the text stands at the first."""
    section, out, i = False, [], 0
    while i < len(lines):
        line = lines[i]
        if i + 1 < len(lines) and re.fullmatch(r"-{3,}", lines[i + 1].strip()):
            section = bool(_SECTION.match(line.strip()))
        found = _TOGETHER.fullmatch(line) if section else None
        out.append(line)
        i += 1
        if found:
            names = found["names"].split(", ")
            kinds = each_its_kind(names, found["kind"])
            out[-1] = f"{names[0]} : {kinds[0]}"
            described = i
            while i < len(lines) and lines[i].startswith(" "):
                out.append(lines[i])
                i += 1
            for other, kind in zip(names[1:], kinds[1:], strict=True):
                out += [f"{other} : {kind}", *([f"    See `{names[0]}`."] if i > described else [])]
    lines[:] = out


def plain_formulas(app, what, name, obj, options, lines):
    """Formulas in docstrings are plain text: `|r|`, `a * b` and `K_` are no markup there."""
    literal = None  # indentation of the paragraph that ended in '::'
    for i, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if literal is not None and line.strip() and indent <= literal:
            literal = None
        if literal is None and not line.lstrip().startswith((">>>", "...", "..")):
            parts = _MARKUP.split(line)
            for j in range(0, len(parts), 2):
                parts[j] = re.sub(r"\||\*|(?<=\w)_(?!\w)", lambda m: "\\" + m.group(0), parts[j])
            lines[i] = "".join(parts)
        if literal is None and line.rstrip().endswith("::"):
            literal = indent


def setup(app):
    copy_notebooks()
    use_this_interpreter(Path(app.doctreedir))
    app.connect("autodoc-process-signature", short_types)
    app.connect("autodoc-process-docstring", one_field_a_line, priority=90)
    app.connect("autodoc-process-docstring", plain_formulas, priority=100)  # before napoleon
