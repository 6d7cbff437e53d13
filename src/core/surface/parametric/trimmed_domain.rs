//! The part of a (u, v) domain that outlines in space enclose.

use super::parametric_surface::{ParametricSurface, has_planar_profile, meridian, range, turned_to};
use crate::geometry::{Point, Vector};

/// Number of places along each parameter at which a search for the nearest place of a B-spline starts.
const STARTS: usize = 32;

/// Outlines in (u, v).
pub(super) struct TrimmedDomain {
    outlines: Vec<Vec<[f64; 2]>>,
    /// Ranges of u and v.
    domain: [[f64; 2]; 2],
    /// Lengths after which u and v repeat; infinite for a parameter that does not.
    pub(super) period: [f64; 2],
    /// Middle of the ranges in which the outlines lie.
    middle: [f64; 2],
    /// The parameter that a scan line keeps constant: 0 for u, 1 for v. It is the one around which outlines go, because
    /// a line along it does not cross them.
    constant: usize,
    /// True if the places beyond the outlines are meant: with an odd number of outlines that go around once.
    is_inverted: bool,
}

impl TrimmedDomain {
    /// Maps outlines in space to (u, v). Returns the domain around them too.
    pub(super) fn of_outlines(surface: &ParametricSurface, outlines: &[Vec<Point>]) -> (Self, [[f64; 2]; 2]) {
        let places: Vec<Point> = outlines.iter().flatten().copied().collect();
        let mut domain = surface.domain_near(&places);
        let mut trimmed = Self::new(surface, domain, outlines);
        // One ring on a cone encloses its apex, which no outline has.
        if let (true, Some(apex)) = (trimmed.is_ambiguous(), surface.apex()) {
            domain[1] = range(domain[1].into_iter().chain([apex]));
            trimmed.domain = domain;
        }
        (trimmed, domain)
    }

    /// Maps outlines in space to (u, v). `domain` has the ranges of u and v.
    fn new(surface: &ParametricSurface, domain: [[f64; 2]; 2], outlines: &[Vec<Point>]) -> Self {
        let period = surface.period();
        let mapped = outlines.iter().filter(|outline| outline.len() > 2).map(|outline| {
            let mut places: Vec<[f64; 2]> = Vec::with_capacity(outline.len());
            for p in outline {
                let found = nearest_parameters(surface, domain, p, places.last().copied());
                let near = places.last().copied().unwrap_or(found);
                places.push([0, 1].map(|k| unwrapped(found[k], near[k], period[k])));
            }
            places
        });
        let mut mapped: Vec<Vec<[f64; 2]>> = mapped.collect();
        // All of them in the turn of the first.
        let centre = |outline: &[[f64; 2]], k: usize| middle(range(outline.iter().map(|place| place[k])));
        if let Some((first, others)) = mapped.split_first_mut() {
            for outline in others {
                let shift = [0, 1].map(|k| {
                    let at = centre(outline, k);
                    unwrapped(at, centre(first, k), period[k]) - at
                });
                outline.iter_mut().for_each(|place| *place = [0, 1].map(|k| place[k] + shift[k]));
            }
        }
        let middle = [0, 1].map(|k| middle(range(mapped.iter().flatten().map(|place| place[k]))));
        let mut trimmed = Self { outlines: mapped, domain, period, middle, constant: 0, is_inverted: false };
        trimmed.constant = usize::from(trimmed.goes_around(1) && !trimmed.goes_around(0));
        trimmed
    }

    /// Tells whether an outline goes around the parameter `k`.
    fn goes_around(&self, k: usize) -> bool {
        self.outlines.iter().any(|outline| self.is_ring(outline, k))
    }

    fn is_ring(&self, outline: &[[f64; 2]], k: usize) -> bool {
        (outline[0][k] - outline[outline.len() - 1][k]).abs() > 0.5 * self.period[k]
    }

    /// Returns the places of the outlines in (u, v).
    pub(super) fn border_places(&self) -> impl Iterator<Item = [f64; 2]> {
        self.outlines.iter().flatten().copied()
    }

    /// Returns a place moved by whole periods into the domain.
    pub(super) fn wrapped(&self, at: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|k| wrapped(at[k], self.domain[k], self.period[k]))
    }

    /// Returns the ranges of u and v in which the enclosed places lie. A parameter around which an outline goes has its
    /// whole range.
    pub(super) fn bounds(&self, domain: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
        if self.outlines.is_empty() || self.is_inverted || self.goes_around(0) || self.goes_around(1) {
            return domain;
        }
        [0, 1].map(|k| range(self.border_places().map(|place| place[k])))
    }

    /// Returns the same domain with the places beyond its outlines.
    pub(super) fn inverted(self) -> Self {
        Self { is_inverted: !self.is_inverted, ..self }
    }

    /// Returns a domain without outlines, which encloses everything.
    pub(super) fn everything(self) -> Self {
        Self { outlines: Vec::new(), is_inverted: false, ..self }
    }

    /// Tells whether one outline, and no other, goes around the surface: then the sides of it cannot be told apart.
    pub(super) fn is_ambiguous(&self) -> bool {
        self.outlines.iter().filter(|outline| self.is_ring(outline, self.constant)).count() % 2 == 1
    }

    /// Returns those places (u, v) of a grid that the outlines enclose.
    pub(super) fn enclosed(&self, us: Vec<f64>, vs: Vec<f64>) -> impl Iterator<Item = [f64; 2]> {
        let [lines, along] = if self.constant == 0 { [us, vs] } else { [vs, us] };
        lines.into_iter().flat_map(move |line| {
            let crossings = self.crossings(line);
            let inside: Vec<f64> = along.iter().copied().filter(|&at| self.contains(&crossings, at)).collect();
            inside.into_iter().map(move |at| if self.constant == 0 { [line, at] } else { [at, line] })
        })
    }

    /// Returns where the outlines cross the line on which the constant parameter is `line`, in rising order.
    fn crossings(&self, line: f64) -> Vec<f64> {
        let (k, other) = (self.constant, 1 - self.constant);
        let mut crossings = Vec::new();
        for outline in &self.outlines {
            let next = outline.iter().skip(1).chain(outline.first());
            for (a, b) in outline.iter().zip(next) {
                // The last edge goes back to the first place, which can be a turn away.
                let end = [0, 1].map(|i| unwrapped(b[i], a[i], self.period[i]));
                let line = unwrapped(line, 0.5 * (a[k] + end[k]), self.period[k]);
                if (a[k] > line) != (end[k] > line) {
                    crossings.push(a[other] + (line - a[k]) / (end[k] - a[k]) * (end[other] - a[other]));
                }
            }
        }
        crossings.sort_by(f64::total_cmp);
        crossings
    }

    /// Tells whether the outlines enclose the place `at` of a scan line, by the number of their edges beyond it.
    fn contains(&self, crossings: &[f64], at: f64) -> bool {
        let other = 1 - self.constant;
        // A parameter with a period names the same place in every turn: take the turn in which the outlines lie.
        let at = unwrapped(at, self.middle[other], self.period[other]);
        let beyond = crossings.len() - crossings.partition_point(|crossing| *crossing <= at);
        self.outlines.is_empty() || (beyond % 2 == 1) != self.is_inverted
    }
}

fn middle([low, high]: [f64; 2]) -> f64 {
    0.5 * (low + high)
}

/// Returns `t` moved by whole periods to where it is nearest to `near`.
fn unwrapped(t: f64, near: f64, period: f64) -> f64 {
    if period.is_finite() { t + ((near - t) / period).round() * period } else { t }
}

/// Returns `t` moved by whole periods into its range, if it lies outside.
pub(super) fn wrapped(t: f64, [low, high]: [f64; 2], period: f64) -> f64 {
    if period.is_finite() && !(low..=high).contains(&t) { low + (t - low).rem_euclid(period) } else { t }
}

/// Returns the parameters of the place of a surface that is nearest to `p`. `near` are those of a place nearby.
pub(super) fn nearest_parameters(
    surface: &ParametricSurface,
    domain: [[f64; 2]; 2],
    p: &Point,
    near: Option<[f64; 2]>,
) -> [f64; 2] {
    let turn = |frame: &super::frame::Frame| {
        let d = frame.local(p);
        (d, d.y.atan2(d.x))
    };
    match surface {
        ParametricSurface::Plane { frame } => {
            let d = frame.local(p);
            [d.x, d.y]
        }
        ParametricSurface::Cylinder { frame, .. } | ParametricSurface::Cone { frame, .. } => {
            let (d, u) = turn(frame);
            [u, d.z]
        }
        ParametricSurface::Sphere { frame, .. } => {
            let (d, u) = turn(frame);
            [u, d.z.atan2(d.x.hypot(d.y))]
        }
        ParametricSurface::Torus { frame, major_radius_mm, .. } => {
            let (d, u) = turn(frame);
            [u, d.z.atan2(d.x.hypot(d.y) - major_radius_mm)]
        }
        ParametricSurface::Revolution { profile, origin, axis } if has_planar_profile(surface) => {
            let x = meridian(profile, origin, axis).unwrap_or_else(Vector::x);
            let out = p - origin;
            let u = out.dot(&axis.cross(&x)).atan2(out.dot(&x));
            [u, profile.parameter_near(&turned_to(profile, origin, axis, p))]
        }
        ParametricSurface::BSpline(_) | ParametricSurface::Extrusion { .. } | ParametricSurface::Revolution { .. } => {
            let start = near.unwrap_or_else(|| nearest_start(surface, domain, p));
            let found = descend(surface, domain, p, start);
            // From a place on the other side of a seam the way leads to its end.
            let distance = |[u, v]: [f64; 2]| (surface.evaluate(u, v).point - p).norm();
            if near.is_none() || distance(found) <= 1e-3 {
                return found;
            }
            let other = descend(surface, domain, p, nearest_start(surface, domain, p));
            if distance(other) < distance(found) { other } else { found }
        }
    }
}

fn nearest_start(surface: &ParametricSurface, [u, v]: [[f64; 2]; 2], p: &Point) -> [f64; 2] {
    let place = |[low, high]: [f64; 2], i: usize| low + (high - low) * i as f64 / STARTS as f64;
    let places = (0..=STARTS).flat_map(|i| (0..=STARTS).map(move |j| [place(u, i), place(v, j)]));
    let distance = |[u, v]: &[f64; 2]| (surface.evaluate(*u, *v).point - p).norm_squared();
    places.min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or([u[0], v[0]])
}

/// Comes nearer to `p` by the method of Gauss and Newton, within the domain.
fn descend(surface: &ParametricSurface, domain: [[f64; 2]; 2], p: &Point, start: [f64; 2]) -> [f64; 2] {
    let mut at = start;
    for _ in 0..30 {
        let found = surface.evaluate(at[0], at[1]);
        let off = p - found.point;
        let [du, dv] = &found.first;
        let (e, f, g) = (du.norm_squared(), du.dot(dv), dv.norm_squared());
        let area = (e * g - f * f).max(1e-12 * e * g);
        if area == 0.0 {
            break;
        }
        let (a, b) = (off.dot(du), off.dot(dv));
        let step = [(a * g - b * f) / area, (b * e - a * f) / area];
        let next = [0, 1].map(|k| (at[k] + step[k]).clamp(domain[k][0], domain[k][1]));
        let moved = [0, 1].map(|k| (next[k] - at[k]).abs() / (domain[k][1] - domain[k][0]));
        at = next;
        if moved[0].max(moved[1]) <= 1e-12 {
            break;
        }
    }
    at
}
