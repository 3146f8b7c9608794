"""Every notebook runs from its first cell to its last in a fresh kernel of this interpreter."""

import sys
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
manager = pytest.importorskip("jupyter_client.manager")
kernelspec = pytest.importorskip("jupyter_client.kernelspec")

NOTEBOOKS = sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))
CELL_SECONDS = 240


class ThisInterpreter(kernelspec.KernelSpecManager):
    """Every kernel name means the running interpreter: a kernel that someone installed under that name is not asked."""

    def get_kernel_spec(self, kernel_name):
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return kernelspec.KernelSpec(argv=argv, display_name=kernel_name, language="python")


class ThisKernel(manager.AsyncKernelManager):
    """Made, and closed with all its sockets, by the client."""

    def _kernel_spec_manager_default(self):
        return ThisInterpreter(parent=self)


def run(notebook, folder):
    """Execute in `folder`; the error names the cell."""
    settings = {"timeout": CELL_SECONDS, "kernel_name": "python3", "kernel_manager_class": ThisKernel}
    client = nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(folder)}}, **settings)
    try:
        client.execute()
    except nbclient.exceptions.CellExecutionError as error:
        last = max((i for i, c in enumerate(notebook.cells) if c.get("execution_count")), default=0)
        first_line = notebook.cells[last].source.strip().splitlines()[0]
        pytest.fail(f"cell {last} ({first_line!r}) failed:\n{error}", pytrace=False)
    return notebook


@pytest.mark.timeout(600)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook(path, tmp_path):
    run(nbformat.read(path, as_version=4), tmp_path)


def notebook_of(*sources):
    return nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(s) for s in sources])


def test_kernel_is_this_interpreter_in_the_given_folder(tmp_path):
    done = run(notebook_of("import os, sys; print(sys.executable); print(os.getcwd())"), tmp_path)
    assert done.cells[0].outputs[0].text.split("\n")[:2] == [sys.executable, str(tmp_path.resolve())]


def test_failing_cell_is_named(tmp_path):
    with pytest.raises(pytest.fail.Exception, match=r"cell 1 \('assert x == 2'\)"):
        run(notebook_of("x = 1", "assert x == 2", "x = 3"), tmp_path)
