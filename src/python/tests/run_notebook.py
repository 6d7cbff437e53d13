"""Runs a notebook in a kernel of its own. With --keep its outputs are written into it."""

import base64
import io
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def small(picture: str) -> str:
    """The same picture with 256 colours: evenly chosen ones, so that rare ends of a scale keep theirs."""
    from PIL import Image

    made = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(picture))) as whole:
        whole.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(made, "PNG", optimize=True)
    return base64.b64encode(made.getvalue()).decode()


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
            data = output.get("data", {})
            if "image/png" in data:
                data.pop("text/plain", None)
                data["image/png"] = small(data["image/png"])
    nbformat.write(notebook, path)
