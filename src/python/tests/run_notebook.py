"""Runs a notebook in a kernel of its own. With --keep its outputs are written into it."""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

path = Path(sys.argv[1])
notebook = nbformat.read(path, as_version=4)
NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}).execute()
outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
pictures = sum("image/png" in output.get("data", {}) for output in outputs)
assert pictures >= 3, f"{path}: {pictures} pictures"
print(f"{path}: {len(notebook.cells)} cells, {pictures} pictures")
if "--keep" in sys.argv:
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            output.get("data", {}).pop("text/plain", None) if "image/png" in output.get("data", {}) else None
    nbformat.write(notebook, path)
