"""Settings of the documentation (Sphinx).  Nothing here asks the network: no remote inventories, no remote scripts."""

import re
import shutil
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

# Notebooks live in notebooks/ without output; the build runs copies of them.
nb_execution_mode = "auto"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
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
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"**": ["sidebar-nav-bs"]}

_MARKUP = re.compile(r"(``.*?``|:[\w:]+:`.*?`|`.*?`_?|https?://\S+|(?<![*\w])\*\*?\w+(?= *[:,]| *$))")


def copy_notebooks() -> None:
    """Copies beside the tutorials' index, the old ones removed."""
    target = HERE / "tutorials"
    for old in target.glob("*.ipynb"):
        old.unlink()
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        shutil.copyfile(notebook, target / notebook.name)


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
    app.connect("autodoc-process-docstring", plain_formulas, priority=100)  # before napoleon
