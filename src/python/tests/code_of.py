"""Prints the Python code of a README or of a notebook, as one module."""

import json
import re
import sys
from pathlib import Path

path = Path(sys.argv[1])
text = path.read_text(encoding="utf-8")
if path.suffix == ".ipynb":
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    print("\n\n".join("".join(cell["source"]) for cell in cells))
else:
    print("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)))
