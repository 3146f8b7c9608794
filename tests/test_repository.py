"""Rules of this repository that no linter knows: sizes, forbidden calls, addresses, machine paths, docstrings, pins.

The files are found by walking the folder, so that the tests also run where there is no git (a downloaded archive).
"""

import ast
import importlib
import inspect
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("models", "ocp", "allocation", "studies")
NOT_OURS = {".git", ".venv", "out", "dist", "_build", "__pycache__", ".hypothesis", ".ipynb_checkpoints"}
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60
BUILD_FILES = ("pyproject.toml", "constraints.txt", "Makefile", ".ci/run", ".pre-commit-config.yaml")
THIRD_PARTY_OF_MODELS = {"casadi", "numpy", "scipy", "ruamel"}  # ruamel reads the data files
HEAVY = {"control", "matplotlib", "pandas", "pydrake", "xarray"}  # imported inside the function that needs them


def our_files(*suffixes, under=ROOT):
    """Every file of the project with one of the suffixes (all text files without)."""
    found = []
    for path in sorted(under.rglob("*")):
        parts = path.relative_to(ROOT).parts
        cache = any(part in NOT_OURS or part.endswith((".egg-info", "_cache")) for part in parts)
        if path.is_file() and not cache and (not suffixes or path.suffix in suffixes):
            found.append(path)
    return found


def product_files():
    return [path for package in PACKAGES for path in our_files(".py", under=ROOT / package)]


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def code_lines(function, lines):
    """Lines of a function without its docstring, blank lines and comments."""
    skipped = set()
    if ast.get_docstring(function, clean=False) is not None:
        skipped = set(range(function.body[0].lineno, function.body[0].end_lineno + 1))
    numbers = (n for n in range(function.lineno, function.end_lineno + 1) if n not in skipped)
    return sum(1 for n in numbers if lines[n - 1].strip() and not lines[n - 1].strip().startswith("#"))


def long_functions(source):
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = {f.name: code_lines(f, source.splitlines()) for f in functions}
    return {name: size for name, size in sizes.items() if size > MAX_FUNCTION_LINES}


def unsafe_uses(source):
    """Calls that run or unpack foreign data, as 'line: what'."""
    found = []
    modules = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [f"{node.lineno}: import {a.name}" for a in node.names if a.name.split(".")[0] in modules]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in modules:
            found.append(f"{node.lineno}: from {node.module}")
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in {"eval", "exec", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "builtins.eval", "builtins.exec"}:
                found.append(f"{node.lineno}: {called}(")
            for keyword in node.keywords:
                value = ast.unparse(keyword.value)
                unsafe_yaml = keyword.arg == "typ" and "unsafe" in value
                if unsafe_yaml or (keyword.arg == "allow_pickle" and value != "False"):
                    found.append(f"{node.lineno}: {keyword.arg}={value}")
    return found


def top_level_imports(tree):
    """Packages imported when the file is imported (functions left out; `if TYPE_CHECKING` too)."""
    found, waiting = set(), list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[0] for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            waiting += [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)]
    return found


def public_without_docstring(module):
    """Exported functions and classes, and public members of these classes, that have no docstring of their own."""
    missing = []
    for name in module.__all__:
        value = getattr(module, name)
        if not (inspect.isclass(value) or inspect.isfunction(value)):
            continue
        text = value.__dict__.get("__doc__") if inspect.isclass(value) else value.__doc__
        if not text or text.startswith(f"{name}("):  # the text that dataclass makes up
            missing.append(name)
        if inspect.isclass(value):
            for member, item in vars(value).items():
                function = item.fget if isinstance(item, property) else getattr(item, "__func__", item)
                if not member.startswith("_") and inspect.isfunction(function) and not function.__doc__:
                    missing.append(f"{name}.{member}")
    return missing


# The checks themselves, seen to fail.


def test_checkers_find_what_they_look_for():
    long = "def f():\n" + "    x = 1\n" * 60
    assert long_functions(long) == {"f": 61}
    documented = 'def f():\n    """' + "text\n" * 30 + '    """\n' + "\n    # why\n    x = 1" * 59
    assert long_functions(documented) == {}
    bad = "import pickle\neval('1')\nyaml.load(f)\nnp.load(f, allow_pickle=True)\nYAML(typ='unsafe')\nfrom pickle import loads\n"
    assert len(unsafe_uses(bad)) == 6
    assert unsafe_uses("model.eval('1')\nnp.load(f, allow_pickle=False)\nYAML(typ='safe')\n") == []
    lazy = "import numpy\nif TYPE_CHECKING:\n    import pandas\ntry:\n    import daqp\nexcept ImportError:\n    pass\n"
    lazy += "def f():\n    import xarray\n"
    assert top_level_imports(ast.parse(lazy)) == {"numpy", "daqp"}


# Size and content of the product code.


def test_files_are_at_most_400_lines():
    sizes = {name_of(p): len(p.read_text(encoding="utf-8").splitlines()) for p in product_files()}
    assert sizes, "no product file was found"
    assert {name: n for name, n in sizes.items() if n > MAX_FILE_LINES} == {}


def test_functions_are_at_most_60_code_lines():
    long = {name_of(p): long_functions(p.read_text(encoding="utf-8")) for p in product_files()}
    assert {name: found for name, found in long.items() if found} == {}


def test_nothing_unpickles_or_evaluates_data():
    found = {name_of(p): unsafe_uses(p.read_text(encoding="utf-8")) for p in product_files()}
    assert {name: uses for name, uses in found.items() if uses} == {}


def test_models_import_casadi_numpy_scipy_and_their_data_readers_only():
    found = {}
    for path in our_files(".py", under=ROOT / "models"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        third_party = top_level_imports(tree) - THIRD_PARTY_OF_MODELS - set(sys.stdlib_module_names) - {"models"}
        if third_party:
            found[name_of(path)] = sorted(third_party)
    assert found == {}


def test_heavy_libraries_are_imported_where_they_are_used():
    found = {}
    for package in ("models", "ocp", "allocation"):
        for path in our_files(".py", under=ROOT / package):
            heavy = top_level_imports(ast.parse(path.read_text(encoding="utf-8"))) & HEAVY
            if heavy:
                found[name_of(path)] = sorted(heavy)
    assert found == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_exist_and_have_docstrings(package):
    module = importlib.import_module(package)
    assert module.__doc__
    assert [n for n in module.__all__ if not hasattr(module, n)] == []
    assert len(set(module.__all__)) == len(module.__all__)
    assert public_without_docstring(module) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_typed(package):
    assert (ROOT / package / "py.typed").is_file()


# Notebooks, build files, text.


def test_notebooks_are_committed_without_output():
    dirty = []
    for path in our_files(".ipynb", under=ROOT / "notebooks"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        if any(c.get("outputs") or c.get("execution_count") is not None for c in cells if c["cell_type"] == "code"):
            dirty.append(name_of(path))
    assert dirty == []


def test_tests_are_flat():
    folders = {name_of(p.parent) for p in our_files(".py", under=ROOT / "tests")}
    assert folders == {"tests"}
    assert not (ROOT / "tests" / "__init__.py").exists()


@pytest.mark.parametrize("name", BUILD_FILES)
def test_build_files_name_no_address(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    text = re.sub(r"(?ms)^\[project\.urls\].*?(?=^\[|\Z)", "", text)  # links to the project's own pages may stand there
    assert re.findall(r"(?:https?|git\+\w+|ssh|ftp)://\S+|--(?:extra-)?index-url|--find-links|--trusted-host", text) == []


def test_no_file_names_a_path_of_one_machine():
    # Ada is nobody: tests invent her folder to see that reports hide it.
    pattern = re.compile(r"(?<![\w.~*-])/(?:home|root|work|Users|mnt)/(?!ada\b)\w+|\b[A-Z]:\\\\?Users")
    suffixes = (".py", ".toml", ".md", ".txt", ".yaml", ".yml", ".csv", ".cff", ".ipynb", ".html", ".css", ".h", "")
    found = {}
    for path in our_files(*suffixes):
        hits = pattern.findall(path.read_text(encoding="utf-8", errors="replace"))
        if hits:
            found[name_of(path)] = hits
    assert found == {}
    assert pattern.findall("see /" + "home/someone/x") != []


def test_constraints_are_exact_versions_and_cover_what_is_installed():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert [p for p in pins if not re.fullmatch(r"[a-z0-9.-]+==[0-9][\w.]*", p)] == []
    pinned = {p.split("==")[0] for p in pins}
    assert len(pinned) == len(pins)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + [d for extra in ("notebook", "solvers", "docs", "dev") for d in extras[extra]]
    names = {re.split(r"[\[<>=; ]", d)[0].lower() for d in wanted} - {project["name"]}
    assert names - pinned == set()


def test_version_is_the_same_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
