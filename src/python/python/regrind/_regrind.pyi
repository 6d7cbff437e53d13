"""
Exact registration of measured probe centres to the offset of a nominal surface, with uncertainty.
"""

from numpy import bool_, float64, uint32
from numpy.typing import ArrayLike, NDArray
from collections.abc import Callable
from os import PathLike
from typing import Literal, Any, Final, SupportsFloat, SupportsIndex, final

__all__ = ["__version__", "Correction", "ErrorMap", "Form", "Interval", "Iso10110", "Nominal", "PolynomialFit", "Registration", "ToolPath", "compensate", "error_map", "gaussian", "iso10110", "model", "read", "register", "toolpath", "write", "zernike_fit"]

__version__: Final[str]
"""
Version of the package.
"""

@final
class Correction:
    """
    Correction of a pass: by how much the surface is to be higher than the nominal surface plus the level.
    """
    def __copy__(self, /) -> Correction:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> Correction:
        """
        Returns the same object: it never changes.
        """
    def __repr__(self, /) -> str: ...
    @property
    def cycle(self, /) -> int:
        """
        Number of the pass that it is for, from 2.
        """
    @property
    def depth(self, /) -> float:
        """
        Depth of the pass below the pass before, in mm: the depth of cut, or more where the part is low.
        """
    @property
    def level(self, /) -> float:
        """
        Height of the target surface above the nominal one without the correction, in mm.
        """
    @property
    def removed(self, /) -> float:
        """
        Removal below the surface of the first pass at the place of the most removal, in mm.
        """
    @property
    def values(self, /) -> NDArray[float64]:
        """
        Displacement of the surface at each node in mm, (N, M), along the outward normal; positive leaves material. It is
        absolute: it replaces that of the pass before.
        """
    @property
    def x(self, /) -> NDArray[float64]:
        """
        Places of the columns along x in mm, (M,).
        """
    @property
    def y(self, /) -> NDArray[float64]:
        """
        Places of the rows along y in mm, (N,).
        """

@final
class ErrorMap:
    """
    Map of the error on a grid, filtered by a Gaussian filter of ISO 16610-61.
    """
    def __copy__(self, /) -> ErrorMap:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> ErrorMap:
        """
        Returns the same object: it never changes.
        """
    def __repr__(self, /) -> str: ...
    @property
    def advice(self, /) -> list[str]:
        """
        Advice on the measurement and the cut-off.
        """
    @property
    def outliers(self, /) -> list[int]:
        """
        Indices of the points that were left out as outliers.
        """
    @property
    def residual_sigma(self, /) -> float:
        """
        Standard deviation of the deviations from the map in mm: the part that the filter removed.
        """
    @property
    def uncertainty(self, /) -> NDArray[float64]:
        """
        Standard uncertainty of the error at each node from the noise of the points in mm, (N, M); NaN where the error is.
        """
    @property
    def values(self, /) -> NDArray[float64]:
        """
        Error at each node in mm, (N, M); NaN where too few points are near.
        """
    @property
    def x(self, /) -> NDArray[float64]:
        """
        Places of the columns along x in mm, (M,).
        """
    @property
    def y(self, /) -> NDArray[float64]:
        """
        Places of the rows along y in mm, (N,).
        """

@final
class Form:
    """
    Form of a part after its own best fit, with its figures and their uncertainty.
    """
    def __copy__(self, /) -> Form:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> Form:
        """
        Returns the same object: it never changes.
        """
    def __repr__(self, /) -> str: ...
    @property
    def frame_covariance(self, /) -> NDArray[float64]:
        """
        Covariance of the pose of the nominal frame including the uncertainty of the form, (6, 6), in mm and rad.
        """
    @property
    def is_detected(self, /) -> bool:
        """
        True if the points show a form. If false, the intervals are upper bounds.
        """
    @property
    def noise_sigma(self, /) -> float:
        """
        Standard deviation of the noise of a single point, in mm.
        """
    @property
    def places(self, /) -> NDArray[float64]:
        """
        Places of these points over x and y of the model frame in mm, (M, 2).
        """
    @property
    def pv(self, /) -> Interval:
        """
        Peak to valley at the used points.
        """
    @property
    def pv_998(self, /) -> Interval:
        """
        Peak to valley over the aperture, without the outermost 0.1 % at each end.
        """
    @property
    def rms(self, /) -> Interval:
        """
        Root mean square.
        """
    def sample(self, /, count: SupportsIndex) -> NDArray[float64]:
        """
        Samples of the form from its posterior at the same points in mm, (`count`, M). Each row is a form that the
        points allow. The same `count` gives the same samples; 1000 are those from which the figures come.

        Raises DataError for 0 samples, and for more than 2e7 values.
        """
    @property
    def uncertainty(self, /) -> NDArray[float64]:
        """
        Standard uncertainty of the form at each of these points in mm, (M,).
        """
    @property
    def values(self, /) -> NDArray[float64]:
        """
        Form at each used point in mm, (M,). A scan of more than 6,000 points is reduced to 6,000.
        """

@final
class Interval:
    """
    Median and 95 % interval of a figure, in mm.
    """
    def __copy__(self, /) -> Interval:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> Interval:
        """
        Returns the same object: it never changes.
        """
    def __repr__(self, /) -> str: ...
    @property
    def high(self, /) -> float:
        """
        Quantile at 97.5 %, in mm.
        """
    @property
    def low(self, /) -> float:
        """
        Quantile at 2.5 %, in mm; 0 if only an upper bound is known.
        """
    @property
    def median(self, /) -> float:
        """
        Median, in mm.
        """

@final
class Iso10110:
    """
    Power, irregularity and symmetric part by ISO 10110-5, in nanometres.
    """
    def __copy__(self, /) -> Iso10110:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> Iso10110:
        """
        Returns the same object: it never changes.
        """
    def __repr__(self, /) -> str: ...
    @property
    def irregularity_nm(self, /) -> float:
        """
        B: peak to valley of the irregularity, in nm.
        """
    @property
    def notation(self, /) -> str:
        """
        Tightest indication of a drawing that the surface meets.
        """
    @property
    def power_nm(self, /) -> float:
        """
        A: peak to valley of the power, in nm.
        """
    @property
    def rms_nm(self, /) -> tuple[float, float, float]:
        """
        RMSt, RMSi and RMSa, in nm.
        """
    @property
    def symmetric_nm(self, /) -> float:
        """
        C: peak to valley of the part of the irregularity that is symmetric about the centre, in nm.
        """

@final
class Nominal:
    """
    Nominal surface: the ideal shape of a part.
    """
    def __copy__(self, /) -> Nominal:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> Nominal:
        """
        Returns the same object: it never changes.
        """
    def __len__(self, /) -> int: ...
    def __repr__(self, /) -> str: ...
    @staticmethod
    def from_file(path: str | PathLike[str], projection: Literal['auto', 'xy', 'best-fit', 'spherical'] = "auto", *, face: int | str | None = None, face_frame: Literal['file', 'face'] = "file") -> Nominal:
        """
        Surface in a file: points as text or PLY, a mesh as STL or PLY, a CAD model as STEP or IGES, or a TOML definition.

        `face` chooses a face of a CAD model by its number from 1 or by its name; without it, it is the largest.
        `face_frame` is "file", or "face" for a frame in the middle of the face with z along its outward normal.

        Raises DataError with the path, the place and the reason.
        """
    @staticmethod
    def from_function(function: Callable[[NDArray[float64], NDArray[float64]], ArrayLike], x: ArrayLike, y: ArrayLike) -> Nominal:
        """
        Surface of a function z = function(x, y) on a grid.

        Shapes: `x` is (M,) and `y` is (N,), in mm. `function` gets two arrays (N, M) and returns the heights in mm in the
        same shape.

        Raises DataError if the heights have another shape, or if no surface can be built from them.

        >>> x = np.linspace(-20, 20, 81)
        >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
        >>> nominal = regrind.Nominal.from_function(saddle, x, x)
        >>> nominal
        Nominal(6561 points, grid of 81 x 81)
        """
    @staticmethod
    def from_mesh(points: ArrayLike, triangles: ArrayLike) -> Nominal:
        """
        Surface of a triangle mesh, oriented by its corners.

        Shapes: `points` is (N, 3), in mm; `triangles` is (M, 3), with indices of points.

        Raises DataError if the mesh is closed or has a mistake.

        >>> corners = [[0, 0, 0], [10, 0, 0], [10, 10, 1], [0, 10, 1]]
        >>> regrind.Nominal.from_mesh(corners, [[0, 1, 2], [0, 2, 3]])
        Nominal(4 points, mesh)
        """
    @staticmethod
    def from_points(points: ArrayLike, projection: Literal['auto', 'xy', 'best-fit', 'spherical'] = "auto") -> Nominal:
        """
        Surface through points: a grid if the points form one, otherwise a triangulation.

        Shapes: `points` is (N, 3), in mm, in any order. `projection` selects the plane of the triangulation of scattered
        points: "auto", "xy", "best-fit" or "spherical".

        Raises DataError if no surface can be built from the points.

        >>> x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
        >>> regrind.Nominal.from_points(np.column_stack([x.ravel(), y.ravel(), 0.01 * x.ravel() ** 2]))
        Nominal(20 points, grid of 5 x 4)
        """
    @staticmethod
    def from_toml(text: str) -> Nominal:
        """
        Surface of the definition in a TOML text, such as an asphere or a free form with its aperture.

        Raises DataError with the place of every mistake.

        >>> regrind.Nominal.from_toml(""\"
        ... [surface]
        ... kind = "asphere"
        ... radius_mm = 180.0
        ... conic = -1.2
        ... coefficients = { A4 = 2.0e-8 }
        ... [aperture]
        ... kind = "circle"
        ... radius_mm = 10.0
        ... [sampling]
        ... spacing_mm = 0.5
        ... ""\")
        Nominal(1457 points, grid of 43 x 43)
        """
    def offset(self, /, distance: SupportsFloat | SupportsIndex) -> NDArray[float64]:
        """
        Points of the offset surface, (N, 3), in mm: the points moved along their normals by `distance` in mm; eq. (3).
        """
    @property
    def points(self, /) -> NDArray[float64]:
        """
        Points of the surface, (N, 3), in mm.
        """

@final
class PolynomialFit:
    """
    Fit of polynomials to deviations.
    """
    def __copy__(self, /) -> PolynomialFit:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> PolynomialFit:
        """
        Returns the same object: it never changes.
        """
    def __repr__(self, /) -> str: ...
    @property
    def coefficients(self, /) -> NDArray[float64]:
        """
        Coefficients in mm, (K,); each polynomial has the mean square 1 over the full disc.
        """
    @property
    def orthogonal(self, /) -> NDArray[float64]:
        """
        Contribution of each polynomial to the root mean square in mm, (K,), after it was made orthogonal at the points.
        """
    @property
    def residual_rms(self, /) -> float:
        """
        Root mean square of the residuals, in mm.
        """
    @property
    def terms(self, /) -> list[str]:
        """
        Name of each polynomial, such as "Z5 (2, 2)".
        """

@final
class Registration:
    """
    Result of a registration.
    """
    def __copy__(self, /) -> Registration:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> Registration:
        """
        Returns the same object: it never changes.
        """
    def __len__(self, /) -> int: ...
    def __repr__(self, /) -> str: ...
    @property
    def alternatives(self, /) -> list[tuple[NDArray[float64], float]]:
        """
        Other poses that fit about as well, each with its rms in mm for a sample of the points.
        """
    @property
    def covariance(self, /) -> NDArray[float64]:
        """
        Covariance of the pose, (6, 6): of the twist [translation; rotation] in the model frame, in mm and rad. Locked and
        undetermined directions have no variance.
        """
    @property
    def coverage(self, /) -> float:
        """
        Share of the nominal surface that is covered by used points, from 0 to 1.
        """
    @property
    def deviations(self, /) -> NDArray[float64]:
        """
        Signed deviation of each measured point from the nominal surface in mm, (N,), in the order given; positive where
        material stands proud.
        """
    @property
    def iterations(self, /) -> int:
        """
        Number of steps of the iteration.
        """
    @property
    def left_out(self, /) -> list[tuple[int, str]]:
        """
        Indices of the points that were left out, with the reason: "outlier" or "off part".
        """
    @property
    def normals(self, /) -> NDArray[float64]:
        """
        Unit normals of the nominal surface at the contact points, (N, 3).
        """
    @property
    def objective(self, /) -> float:
        """
        Sum of the squared deviations of the used points, in mm²; eq. (7).
        """
    @property
    def objectives(self, /) -> NDArray[float64]:
        """
        Sum of the squared deviations after each step that was tried, in mm²; eq. (15).
        """
    @property
    def points(self, /) -> NDArray[float64]:
        """
        Contact points in the model frame in mm, (N, 3).
        """
    @property
    def pose(self, /) -> NDArray[float64]:
        """
        Pose that maps coordinates of the model to coordinates of the measuring machine, (4, 4), in mm: g of the method.
        """
    @property
    def pv(self, /) -> float:
        """
        Largest minus smallest deviation of the used points, in mm.
        """
    @property
    def rms(self, /) -> float:
        """
        Root mean square of the deviations of the used points, in mm.
        """
    @property
    def uncertainty(self, /) -> NDArray[float64]:
        """
        Standard uncertainty of each deviation in mm, (N,).
        """
    @property
    def used(self, /) -> NDArray[bool_]:
        """
        True for each point that counts in every figure, (N,).
        """
    @property
    def warnings(self, /) -> list[str]:
        """
        Warnings to read before the pose is trusted.
        """
    @property
    def weak_directions(self, /) -> list[str]:
        """
        Directions in words that the surface determines badly or not at all.
        """

@final
class ToolPath:
    """
    Path of the centre of a wheel over a part.
    """
    def __copy__(self, /) -> ToolPath:
        """
        Returns the same object: it never changes.
        """
    def __deepcopy__(self, /, _memo: Any) -> ToolPath:
        """
        Returns the same object: it never changes.
        """
    def __len__(self, /) -> int: ...
    def __repr__(self, /) -> str: ...
    @property
    def duration(self, /) -> float:
        """
        Time of the moves at feed in s, without the time for acceleration.
        """
    @property
    def length(self, /) -> float:
        """
        Length of the path at feed, in mm.
        """
    @property
    def points(self, /) -> NDArray[float64]:
        """
        Places of the centre of the wheel at feed in the model frame in mm, (N, 3).

        Raises DataError for a path of more than 5e7 points.
        """
    @property
    def track(self, /) -> float:
        """
        Distance of the tracks over x and y, in mm.
        """
    @property
    def tracks(self, /) -> NDArray[uint32]:
        """
        Index of the track of each of these points, (N,). A track that leaves the part and comes back has several.

        Raises DataError for a path of more than 5e7 points.
        """

def compensate(error_map: ErrorMap, *, depth_of_cut: SupportsFloat | SupportsIndex, max_correction: SupportsFloat | SupportsIndex, removal_budget: SupportsFloat | SupportsIndex, previous: Correction | None = None, allowance: SupportsFloat | SupportsIndex | None = None, gain: SupportsFloat | SupportsIndex = 1.0, min_depth: SupportsFloat | SupportsIndex = 0.0005, max_depth: SupportsFloat | SupportsIndex | None = None) -> Correction:
    """
    Correction of the next pass: the last correction minus `gain` times the measured error, within limits.

    A pass can only remove material, so the next pass is deeper by `depth_of_cut` in mm, or by more where the correction
    rises. `previous` is the correction of the pass that was measured; without it, that pass was the first, had none, and left
    `allowance` in mm. `max_correction` limits the correction at any place, `removal_budget` the removal below the first
    pass, `max_depth` the depth of the pass at any place, and `min_depth` is the least depth of cut at any place; all in
    mm.

    Raises DataError if a limit would be exceeded: the text says where, by how much, and what to do.

    >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
    >>> places = np.column_stack([x.ravel(), y.ravel()])
    >>> map = regrind.error_map(places, 1e-4 * x.ravel(), cutoff=4, spacing=2)
    >>> regrind.compensate(map, depth_of_cut=0.02, max_correction=0.06, removal_budget=0.4)
    Correction(11 x 11 nodes, pass 2, depth 20.000 um)
    """

def error_map(places: ArrayLike, deviations: ArrayLike, *, cutoff: SupportsFloat | SupportsIndex, spacing: SupportsFloat | SupportsIndex | None = None, robust: bool = False) -> ErrorMap:
    """
    Map of the error on a grid, by a Gaussian regression filter of ISO 16610-61 at scattered points.

    Shapes: `places` is (N, 2) or (N, 3), in mm; `deviations` is (N,), in mm. `cutoff` is the wavelength in mm at which half
    of the amplitude passes, `spacing` the distance of the nodes in mm; without it, it is a fifth of the cut-off. `robust`
    selects the robust filter of ISO 16610-71.

    Raises DataError if the points are too few or too far apart for the cut-off.

    >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
    >>> places = np.column_stack([x.ravel(), y.ravel()])
    >>> map = regrind.error_map(places, 1e-4 * x.ravel(), cutoff=4, spacing=2)
    >>> (1e3 * map.values[5]).round(3).tolist()
    [-1.0, -0.8, -0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """

def gaussian(values: ArrayLike, *, spacing: ArrayLike, cutoff: SupportsFloat | SupportsIndex, order: Literal[0, 1, 2] = 1, robust: bool = False) -> NDArray[float64]:
    """
    Filters a map of heights by the areal Gaussian filter of ISO 16610-61.

    Shapes: `values` is (N, M); NaN marks nodes without a value. `spacing` is the distance of the nodes along x and y, or one number for both, and
    `cutoff` the wavelength at which half of the amplitude passes, in mm. `order` is that of the polynomial that passes
    unchanged: 0, 1 or 2. `robust` selects the robust filter of ISO 16610-71. The result is (N, M); nodes with too few
    values around them are NaN. A node without a value gets that of the filter if enough nodes around it have one.

    Raises DataError for arguments that cannot be used.

    >>> heights = np.tile([1.0, -1.0], (20, 10))
    >>> round(abs(regrind.gaussian(heights, spacing=(1, 1), cutoff=8)[:, 6:14]).max().item(), 2)
    0.0
    """

def iso10110(places: ArrayLike, deviations: ArrayLike, *, radius: SupportsFloat | SupportsIndex | None = None, centre: ArrayLike | None = None, wavelength: SupportsFloat | SupportsIndex = 632.8e-6) -> Iso10110:
    """
    Figures of ISO 10110-5 of deviations, without piston and tilt.

    Shapes: `places` is (N, 2) or (N, 3), of which x and y are used, in mm; `deviations` is (N,), in mm. `radius` is that of
    a round part about `centre`, by default the origin, in mm; without it, the centre is that of the bounds of the points.
    `wavelength` is in mm and only appears in the notation.

    Raises DataError if the points do not determine the figures.

    >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
    >>> places = np.column_stack([x.ravel(), y.ravel()])
    >>> round(regrind.iso10110(places, 1e-5 * (x**2 + y**2).ravel()).power_nm)
    2000
    """

def model(registration: Registration, *, radius_uncertainty: SupportsFloat | SupportsIndex = 0.0, length_uncertainty: SupportsFloat | SupportsIndex = 0.0) -> Form:
    """
    Separates the form from the noise of the probe by a Gaussian process, and states PV and RMS with 95 % intervals.

    `radius_uncertainty` is the standard uncertainty of the radius of the probe in mm, and `length_uncertainty` the
    relative standard uncertainty of all lengths. No point can show them, so both are 0 unless they are stated.

    The form is that after its best fit: the motion of the part that is closest to it does not count.

    Raises DataError for an uncertainty beyond its limit, and ModelError with the reason if the deviations give no model.

    >>> x = np.linspace(-20, 20, 81)
    >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
    >>> nominal = regrind.Nominal.from_function(saddle, x, x)
    >>> noise = np.random.default_rng(1).normal(0, 2e-4, nominal.points[::7].shape)
    >>> found = regrind.register(nominal, nominal.offset(1.5)[::7] + noise, probe_radius=1.5)
    >>> form = regrind.model(found)
    >>> print(f"noise of the probe: {1e3 * form.noise_sigma:.1f} um")
    noise of the probe: 0.2 um
    """

def read(path: str | PathLike[str]) -> NDArray[float64]:
    """
    Measured points of a file: text, PLY, or the map of an interferometer or a profilometer. The array is (N, 3), in mm.

    Raises DataError with the path, the place and the reason.
    """

def register(nominal: Nominal, measured: ArrayLike, *, probe_radius: SupportsFloat | SupportsIndex, side: Literal['auto', 'above', 'below'] = "auto", lock: str | list[str] | None = None, loss: Literal['none', 'huber', 'tukey'] = "none", initial: ArrayLike | None = None, method: Literal['offset', 'contact', 'subtract-radius'] = "offset", distance: Literal['curved', 'triangle'] = "curved", outlier_sigmas: SupportsFloat | SupportsIndex = 6.0, max_rms: SupportsFloat | SupportsIndex | None = None) -> Registration:
    """
    Registers measured points to the offset of a nominal surface, without an initial guess.

    Finds the pose g that minimises the sum of the squared distances of the measured points from the offset surface, as
    eq. (7) of the method, exactly between the points of the nominal surface.

    Shapes: `measured` is (N, 3), in mm, in the frame of the measuring machine, in any order. `probe_radius` is in mm; 0
    means contact points. `side` is "auto", "above" or "below". `lock` names coordinates of the motion that stay 0, such as
    "x,y,rz" or ["x", "y"]: shifts along and rotations about the axes of the model frame, from `initial`, or from the
    identity if that is not given. `loss` is "none", "huber" or "tukey"; `initial` is a pose (4, 4) at which the search
    starts; `method` is "offset", "contact" or "subtract-radius"; `distance` is "curved" or "triangle". Points beyond
    `outlier_sigmas` robust standard deviations do not move the pose; `max_rms` in mm refuses a worse fit.

    Raises DataError for arguments that cannot be used, and RegistrationError with the reason if the points cannot be
    registered.

    >>> x = np.linspace(-20, 20, 81)
    >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
    >>> nominal = regrind.Nominal.from_function(saddle, x, x)
    >>> measured = nominal.offset(1.5)[::7] + [3, 2, 1]
    >>> found = regrind.register(nominal, measured, probe_radius=1.5)
    >>> found.pose[:3, 3].round(5)
    array([3., 2., 1.])
    """

def toolpath(nominal: Nominal, correction: Correction | None = None, *, wheel_radius: SupportsFloat | SupportsIndex, feed: SupportsFloat | SupportsIndex, track: SupportsFloat | SupportsIndex | None = None, scallop: SupportsFloat | SupportsIndex | None = None, rim_radius: SupportsFloat | SupportsIndex | None = None, pattern: Literal['raster', 'spiral'] = "raster", one_way: bool = False, side: Literal['above', 'below'] = "above", chord_error: SupportsFloat | SupportsIndex = 1e-4, overrun: SupportsFloat | SupportsIndex = 2.0, safe_height: SupportsFloat | SupportsIndex = 10.0) -> ToolPath:
    """
    Path of the wheel over the nominal surface plus a correction.

    The wheel is a ball of `wheel_radius`, or with `rim_radius` a disc with a round rim whose spindle is along y; both in
    mm. `track` is the distance of the tracks in mm, or `scallop` is the height h in mm of the ridges between them, to first
    order: h = track² / (8 r), with 1/r the curvature of the wheel less that of the surface.
    `feed` is in mm/min. `pattern` is "raster" or "spiral". `side` is the side from which the wheel comes: "above" or
    "below". `chord_error` is the greatest distance of the lines between the points from the path in mm. `overrun` is the
    length of the tracks beyond the edge, before which and after which the wheel comes down and lifts off along 2 mm more at
    feed; `safe_height` is the height of rapid moves above the path; both in mm.

    Raises DataError if the wheel does not fit the surface: the text says where, by how much, and what to do.

    >>> x = np.linspace(-20, 20, 81)
    >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
    >>> nominal = regrind.Nominal.from_function(saddle, x, x)
    >>> path = regrind.toolpath(nominal, wheel_radius=5, track=2, feed=600, chord_error=1e-3)
    >>> path.tracks[-1]
    np.uint32(20)
    """

def write(path: str | PathLike[str], what: ArrayLike | Registration | ErrorMap | Correction | ToolPath, *, nominal: Nominal | None = None, cycle: SupportsIndex = 1, dialect: Literal['linuxcnc', 'fanuc', 'sinumerik', 'heidenhain'] = "linuxcnc", controller_tolerance: SupportsFloat | SupportsIndex | None = None) -> None:
    """
    Writes points, deviations, a map, a correction or a program, completely or not at all.

    `what` decides the content: an array (N, 3) in mm gives the columns x_mm, y_mm, z_mm; a Registration gives the file
    deviations.csv of the command line; an ErrorMap gives error_map.csv, or X3P if `path` ends with .x3p; a Correction
    gives correction.csv; a ToolPath gives a program in the `dialect` "linuxcnc", "fanuc", "sinumerik" or "heidenhain".
    Maps and corrections as text state the part that they belong to, so they need `nominal`. `cycle` is the number of the
    pass that a map was measured after. `controller_tolerance` is by how much the control rounds corners, in mm: a dialect
    that cannot state it in the program needs it.

    Raises DataError with the path and the reason; a file of that name is then unchanged.
    """

def zernike_fit(places: ArrayLike, deviations: ArrayLike, *, radius: SupportsFloat | SupportsIndex, centre: ArrayLike | None = None, terms: SupportsIndex = 36) -> PolynomialFit:
    """
    Fits Fringe Zernike polynomials to deviations by least squares at the places of the points.

    Shapes: `places` is (N, 2) or (N, 3), in mm; `deviations` is (N,), in mm. `radius` and `centre` are those of the disc, by default about the origin, in
    mm. `terms` is the number of polynomials, 1 to 37.

    Raises DataError if the points do not determine the polynomials.

    >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
    >>> places = np.column_stack([x.ravel(), y.ravel()])
    >>> fit = regrind.zernike_fit(places, 1e-5 * x.ravel(), radius=10, terms=4)
    >>> fit.terms[1], (1e6 * fit.coefficients[1]).round(3).item()
    ('Z2 (1, 1)', 50.0)
    """
