"""The Python code that README and documentation show runs as it stands there."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    "README.md",
    "docs/concepts.md",
    "docs/modulators.md",
    "docs/jet_loop.md",
    "docs/orbiter.md",
    "docs/allocation.md",
    "docs/tutorials/own_model.md",
]


def python_blocks(text):
    return re.findall(r"(?ms)^```python\n(.*?)^```$", text)


@pytest.mark.parametrize("page", PAGES)
def test_python_of_the_page_runs(page, tmp_path):
    blocks = python_blocks((ROOT / page).read_text(encoding="utf-8"))
    assert blocks, f"{page} shows no Python"
    script = tmp_path / "page.py"
    script.write_text("\n".join(blocks), encoding="utf-8")
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-W", "error", str(script)]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_pages_of_the_documentation_are_in_its_contents():
    contents = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert page.stem == "index" or re.search(rf"(?m)^{page.stem}$", contents), f"{page.name} is in no table of contents"


def test_reference_names_every_module():
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    files = [p for package in ("models", "ocp", "allocation", "studies") for p in (ROOT / package).glob("[a-z]*.py")]
    assert files
    assert [f"{p.parent.name}.{p.stem}" for p in files if f"`{p.parent.name}.{p.stem}`" not in text] == []


def test_readme_names_the_make_targets_that_exist():
    targets = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8")))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"(?ms)^```\n(.*?)^```$", text) + re.findall(r"`([^`\n]+)`", text))
    named = set(re.findall(r"\bmake ([a-z-]+)", code))
    assert {"study", "test"} <= named <= targets
