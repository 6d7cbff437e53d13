"""Reads a map with x3pio and prints what is in it as JSON: places and heights in metres, null where nothing was measured."""

import json
import sys
import zipfile

import numpy as np
import x3pio


def plain(values):
    return [None if np.isnan(v) else float(v) for v in values.ravel()]


path = sys.argv[1]
surface = x3pio.read(path)
(layer,) = surface.layers
rows, columns = layer.z.shape
places = layer.points()
# The mask as it stands in the file, for the reader itself gives only the values.
with zipfile.ZipFile(path) as container:
    bits = np.frombuffer(container.read("bindata/valid.bin"), np.uint8)
mask = np.unpackbits(bits, bitorder="little")[: rows * columns].astype(bool)
print(
    json.dumps(
        {
            "columns": columns,
            "rows": rows,
            "x_m": plain(places[..., 0]),
            "y_m": plain(places[..., 1]),
            "z_m": plain(layer.z),
            "mask": mask.tolist(),
            "comment": surface.metadata.comment,
            "date": surface.metadata.date.isoformat(),
        }
    )
)
