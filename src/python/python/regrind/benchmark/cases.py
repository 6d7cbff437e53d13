"""Cases of the benchmark: points of a nominal surface, measured probe centres, and what is true of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .surfaces import Array, FreeForm, Polynomial, Surface, exact, moved, normals_of, placement, points_of

PROBE_RADIUS = 1.5
NOISE = 2e-4
NEAR = placement((0.05, 0.02, -0.03), (0.01, 0.02, 0.03))
FAR = placement((20.0, 10.0, 20.0), (20.0, 20.0, 10.0))


@dataclass
class Case:
    """One problem: which pose brings the nominal surface to the measured probe centres?"""

    name: str
    #: Points of the nominal surface, in mm.
    nominal: Array
    #: Rows and columns of their grid, which contenders are told; None for scattered points.
    grid: tuple[int, int] | None
    #: Measured probe centres in mm, and the radius of the probe; negative if the probe is on the side of -z.
    measured: Array
    radius: float
    #: Distances in mm within which a program that pairs nearest points finds partners, from coarse to fine.
    reaches: tuple[float, ...]
    #: Measured points that are no outliers.
    inliers: NDArray_bool
    surface: Surface
    #: Pose near the answer, from which the exact one is searched.
    near_answer: Array
    #: Points of the model at which the error of a pose is told, in mm.
    corners: Array
    #: Pose at which every contender starts.
    start: Array = field(default_factory=lambda: np.eye(4))

    def exact(self) -> tuple[Array, Array]:
        """Exact pose of the inliers, and the deviations of all measured points there."""
        pose, _ = exact(self.surface, self.measured[self.inliers], self.near_answer, self.radius)
        _, deviations = exact(self.surface, self.measured[self.inliers], pose, self.radius)
        every = np.full(len(self.measured), np.nan)
        every[self.inliers] = deviations
        return pose, every


NDArray_bool = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


def lattice(columns: int, rows: int, width: float, depth: float) -> tuple[Array, Array]:
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, columns), np.linspace(-depth / 2, depth / 2, rows))
    return x.ravel(), y.ravel()


def form_error(rng: np.random.Generator) -> Callable[[Array, Array], Array]:
    """A smooth random form error of 6.657 um PV, as a function of x and y."""
    k = rng.normal(0, np.sqrt(2) / 30, (96, 2))
    c = rng.uniform(0, 2 * np.pi, 96)

    def raw(x: Array, y: Array) -> Array:
        total: Array = np.zeros_like(x)
        for (kx, ky), phase in zip(k, c, strict=True):
            total = total + np.cos(kx * x + ky * y + phase)
        return total

    scale = 6.657e-3 / np.ptp(raw(*lattice(101, 101, 102, 62)))

    def scaled(x: Array, y: Array) -> Array:
        error: Array = scale * raw(x, y)
        return error

    return scaled


def centres(form: Callable[[Array, Array], Array], x: Array, y: Array) -> Array:
    """Probe centres on the ground surface, with its own normals from central differences."""
    surface, h = FreeForm(), 1e-3

    def ground(x: Array, y: Array) -> Array:
        at: Array = points_of(surface, x, y) + form(x, y)[:, None] * normals_of(surface, x, y)
        return at

    along = [(ground(x + dx, y + dy) - ground(x - dx, y - dy)) / (2 * h) for dx, dy in ((h, 0.0), (0.0, h))]
    m = np.cross(along[0], along[1])
    at: Array = ground(x, y) + PROBE_RADIUS * m / np.linalg.norm(m, axis=1)[:, None]
    return at


def free_form_cases(seed: int = 1) -> dict[str, Callable[[], Case]]:
    """The public cases, by name; each is made when it is called."""
    surface = FreeForm()
    form = form_error(np.random.default_rng(seed))
    corner_x, corner_y = np.array([-50.0, 50, -50, 50]), np.array([-30.0, -30, 30, 30])
    corners = points_of(surface, corner_x, corner_y)

    def case(
        name: str,
        *,
        pose: Array = NEAR,
        nominal: tuple[int, int] | int = (501, 901),
        measured: tuple[int, int] = (126, 226),
        noise: float = NOISE,
        outlier_share: float = 0.0,
        part: tuple[float, float, float, float] = (-50.0, 50.0, -30.0, 30.0),
    ) -> Case:
        rng = np.random.default_rng([seed, *name.encode()])
        if isinstance(nominal, tuple):
            rows, columns = nominal
            x, y = lattice(columns, rows, 102.0, 62.0)
        else:
            x, y = rng.uniform(-51.0, 51.0, nominal), rng.uniform(-31.0, 31.0, nominal)
        # A millimetre inside the edge, where the ball touches the part wherever it leans.
        at_x, at_y = np.meshgrid(np.linspace(part[0], part[1], measured[1]), np.linspace(part[2], part[3], measured[0]))
        touched = centres(form, at_x.ravel(), at_y.ravel())
        count = len(touched)
        touched += rng.normal(0, noise, touched.shape)
        inliers = np.ones(count, dtype=bool)
        if outlier_share > 0.0:
            chosen = rng.choice(count, round(outlier_share * count), replace=False)
            inliers[chosen] = False
            # Dust lifts the probe: outliers lie on one side only, which is worst for least squares.
            lifted = rng.uniform(0.02, 0.5, len(chosen))
            touched[chosen] += lifted[:, None] * normals_of(surface, touched[chosen, 0], touched[chosen, 1])
        far = pose is FAR
        return Case(
            name=name,
            nominal=points_of(surface, x, y),
            grid=nominal if isinstance(nominal, tuple) else None,
            measured=moved(pose, touched),
            radius=PROBE_RADIUS,
            reaches=(100.0, 2.0) if far else (2.0,),
            inliers=inliers,
            surface=surface,
            near_answer=pose,
            corners=corners,
        )

    return {
        "grid": lambda: case("grid"),
        "scattered": lambda: case("scattered", nominal=100_000),
        "far": lambda: case("far", pose=FAR),
        "outliers": lambda: case("outliers", outlier_share=0.05),
        "partial": lambda: case("partial", part=(-50.0, -10.0, -30.0, 0.0), measured=(80, 110)),
        "noisy": lambda: case("noisy", noise=5e-3),
        "dense": lambda: case("dense", pose=FAR, measured=(501, 901)),
    }


#: Mirror M1 of a telescope: z = sum of a (x/3000)^i (y/3000)^j in mm, after the designers' own program.
MIRROR = Polynomial(
    3000.0,
    (
        *((0, 2, -57.74022), (0, 3, 1.5373825), (0, 4, 1.154294), (0, 5, -0.441762), (0, 6, 0.0906601)),
        *((2, 0, -72.17349), (2, 1, 1.8691899), (2, 2, 2.8859421), (2, 3, -1.026471), (2, 4, 0.2610568)),
        *((4, 0, 1.8083973), (4, 1, -0.603195), (4, 2, 0.2177414), (6, 0, 0.0394559)),
    ),
)
TRACKER_RADIUS = 19.05


def mirror(folder: Path) -> Case:
    """Centres of a reflector on a telescope's mirror of 6 m, measured by a laser tracker.

    `folder` is one session of the data of the LAT_Alignment project; its file ``*_surface.txt`` has the columns x, y, z of
    the model and the residuals of x, y, z.
    """
    files = sorted(folder.glob("*_surface.txt"))
    if not files:
        raise FileNotFoundError(f"{folder}: there is no file *_surface.txt")
    rows = np.loadtxt(files[0], usecols=range(6), comments="#")
    measured = rows[:, :3] + rows[:, 3:]
    rows_count = columns = 661
    x, y = lattice(columns, rows_count, 6600.0, 6600.0)
    corners = np.array([-2500.0, 2500, -2500, 2500]), np.array([-2500.0, -2500, 2500, 2500])
    return Case(
        name="mirror",
        nominal=points_of(MIRROR, x, y),
        grid=(rows_count, columns),
        measured=measured,
        radius=-TRACKER_RADIUS,
        reaches=(100.0, 30.0),
        inliers=np.ones(len(measured), dtype=bool),
        surface=MIRROR,
        near_answer=np.eye(4),
        corners=points_of(MIRROR, *corners),
    )
