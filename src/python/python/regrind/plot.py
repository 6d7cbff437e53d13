"""Pictures of results by matplotlib, in the manner of the report: on the scale of the tolerance, with sign and extremes.

Needs matplotlib: ``pip install regrind[plot]``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._errors import DataError
from ._regrind import ErrorMap, Registration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Colours of a deviation, from too little material (blue) over none to too much (red): ColorBrewer's RdBu, reversed.
COLOURS = (
    *("#053061", "#2166ac", "#4393c3", "#92c5de", "#d1e5f0", "#f7f7f7"),
    *("#fddbc7", "#f4a582", "#d6604d", "#b2182b", "#67001f"),
)
# Values in tolerance have only a tint, and there is a step at its end: shares of an arm of the scale.
_TINT, _STEP = 0.12, 0.4


def show(
    what: Registration | ErrorMap,
    *,
    limit: float | None = None,
    tolerance: float | None = None,
    ax: Axes | None = None,
    title: str = "",
) -> Axes:
    """Draws deviations at their places, or a map of the error, over x and y of the model frame.

    ``limit`` is the end of the colour scale in mm; without it, the largest magnitude rounded up to 1, 2 or 5. Values from
    -``tolerance`` to ``tolerance`` in mm have only a tint. Crosses mark the extremes. Returns the axes.

    Raises DataError for a limit or a tolerance that is not above 0.
    """
    if isinstance(what, Registration):
        places, values = what.points[what.used, :2], what.deviations[what.used]
    elif isinstance(what, ErrorMap):
        x, y = np.meshgrid(what.x, what.y)
        known = np.isfinite(what.values)
        places, values = np.column_stack([x[known], y[known]]), what.values[known]
    else:
        raise DataError(f"what is a {type(what).__name__}; it must be a Registration or an ErrorMap")
    if values.size == 0:
        raise DataError("what has no value to draw")
    band_um = None if tolerance is None else 1e3 * _above_zero("tolerance", tolerance)
    end_um = 1e3 * (rounded_up(float(np.abs(values).max())) if limit is None else _above_zero("limit", limit))
    least_um = 1.25 * (band_um or 0.0)
    if limit is not None and end_um < least_um:
        raise DataError(f"limit is {limit}; it must be 1.25 times tolerance at least, {1e-3 * least_um}")
    end_um = max(end_um, least_um)
    axes = _axes(ax)
    style: dict[str, Any] = {"cmap": _colour_map(band_um, end_um), "vmin": -end_um, "vmax": end_um}
    drawn: Any
    if isinstance(what, ErrorMap):
        drawn = axes.pcolormesh(what.x, what.y, 1e3 * what.values, shading="nearest", rasterized=True, **style)
    else:
        drawn = axes.scatter(
            places[:, 0],
            places[:, 1],
            c=1e3 * values,
            s=_marker_size(axes, places),
            marker="s",
            linewidths=0,
            rasterized=True,
            **style,
        )
    for index, word in ((int(values.argmax()), "highest"), (int(values.argmin()), "lowest")):
        axes.plot(*places[index], marker="+", color="black", markersize=10, linestyle="none", label=f"{word} {1e3 * values[index]:+.2f} µm")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    axes.set(aspect="equal", xlabel="x in mm", ylabel="y in mm", title=title)
    # As high as the picture itself, which keeps its proportions.
    beside = axes.inset_axes((1.03, 0.0, 0.035, 1.0))
    extend = "both" if 1e3 * np.abs(values).max() > end_um else "neither"
    bar = axes.figure.colorbar(drawn, cax=beside, extend=extend)
    bar.set_label("deviation in µm: red is too much material")
    return axes


def histogram(deviations: ArrayLike, *, ax: Axes | None = None, bins: int = 60) -> Axes:
    """Draws how often each deviation occurs, in µm, with the mean and the root mean square. Returns the axes."""
    values = 1e3 * np.ma.filled(np.ma.asarray(deviations, dtype=float), np.nan).ravel()
    values = values[np.isfinite(values)]
    if values.size == 0:
        raise DataError("deviations has no finite number")
    axes = _axes(ax)
    axes.hist(values, bins=bins, color=COLOURS[1])
    rms = float(np.sqrt(np.mean(values**2)))
    axes.set(xlabel="deviation in µm", ylabel="points", title=f"mean {values.mean():+.3f} µm, RMS {rms:.3f} µm")
    return axes


def rounded_up(value: float) -> float:
    """Next number of the series 1, 2, 5, 10 ... that is not below ``value``; 1e-9 mm at least."""
    if value <= 1e-9:
        return 1e-9
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(step * decade for step in (1.0, 2.0, 5.0, 10.0, 20.0) if step * decade >= value * (1 - 1e-9)))


def _marker_size(axes: Axes, places: NDArray[np.float64]) -> float:
    """Size of squares, in square points, that cover the area between the places."""
    width, height = np.maximum(np.ptp(places, axis=0), 1e-9)
    box = axes.get_window_extent()
    points_per_mm = 72.0 / axes.figure.dpi * min(box.width / width, box.height / height)
    return float(1.3 * width * height / len(places) * points_per_mm**2)


def _above_zero(name: str, value: float) -> float:
    if not (value > 0.0 and np.isfinite(value)):
        raise DataError(f"{name} is {value}; it must be a finite number of mm above 0")
    return value


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def _colour_map(band_um: float | None, end_um: float) -> Any:
    from matplotlib.colors import LinearSegmentedColormap, ListedColormap

    plain = LinearSegmentedColormap.from_list("deviation", COLOURS, N=2048)
    if band_um is None:
        return plain
    values = np.linspace(-end_um, end_um, 2048)
    beyond = np.clip((np.abs(values) - band_um) / (end_um - band_um), 0.0, 1.0)
    arm = np.where(np.abs(values) <= band_um, _TINT * np.abs(values) / band_um, _STEP + (1.0 - _STEP) * beyond)
    return ListedColormap(plain(0.5 + 0.5 * np.copysign(arm, values)), name="deviation")
