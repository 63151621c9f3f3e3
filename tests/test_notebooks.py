"""The notebooks run from top to bottom, use public names only, and carry nothing of the machine they were made on."""

import ast
import os
import sys
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SECONDS = 1800  # for one cell; the notebooks take minutes, on a busy machine many
MAX_BYTES = 100_000  # of a notebook without outputs
PLACES = ("/work", "/tmp", "/root", "/home", "/Users", "site-packages", "C:\\\\")  # as they stand in JSON

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.slow
@each
def test_it_runs(path, tmp_path, monkeypatch):
    from jupyter_client.manager import AsyncKernelManager

    class ThisInterpreter(AsyncKernelManager):
        """Kernels of the interpreter that runs the tests, whatever kernel specs the machine has."""

        def format_kernel_cmd(self, extra_arguments=None):
            return [sys.executable, "-m", "ipykernel_launcher", "-f", self.connection_file, *(extra_arguments or [])]

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("PYTHONWARNINGS", "ignore::DeprecationWarning")  # as in a reader's session
    notebook = nbformat.read(path, as_version=4)
    probe = nbformat.v4.new_code_cell("import sys; print(sys.executable)")
    notebook.cells.append(probe)
    manager = ThisInterpreter(kernel_name="python3")
    client = nbclient.NotebookClient(notebook, km=manager, timeout=SECONDS, resources={"metadata": {"path": tmp_path}})
    client.execute(env=dict(os.environ))  # raises CellExecutionError with the traceback
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert notebook.cells[-1].outputs[0].text.strip() == sys.executable
    assert not list(tmp_path.iterdir()), "a notebook leaves no files behind"


@each
def test_it_is_stored_without_outputs(path):
    """`nbstripout FILE` removes them; the documentation site executes the notebooks."""
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert [cell.outputs for cell in cells] == [[] for _ in cells]
    assert {cell.execution_count for cell in cells} == {None}
    assert path.stat().st_size < MAX_BYTES


@each
def test_it_holds_no_path_of_the_machine(path):
    text = path.read_text(encoding="utf-8")
    assert not [place for place in PLACES if place in text]


@each
def test_it_uses_public_names_only(path):
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert not private_names("\n".join(code))


def private_names(code: str) -> list[str]:
    """Underscore names that are imported from torchcloth, or read as attributes of anything."""
    found = []
    for node in ast.walk(ast.parse(code)):
        names = []
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "torchcloth":
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [part for a in node.names if a.name.startswith("torchcloth") for part in a.name.split(".")]
        elif isinstance(node, ast.Attribute):
            names = [node.attr]
        found += [name for name in names if name.startswith("_") and not name.endswith("__")]
    return found


@pytest.mark.parametrize(
    "code",
    [
        "from torchcloth._utils.linalg import cross",
        "from torchcloth.effects import _curvature",
        "import torchcloth.effects._curvature",
        "import torchcloth as tc\ntc._math",
        "cloth._area",
    ],
)
def test_private_names_are_found(code):
    assert private_names(code)


def test_public_names_are_left_in_peace():
    assert not private_names(
        "import torchcloth as tc\nfrom torchcloth.losses import closest\nfor _ in [tc.__version__]: pass"
    )
