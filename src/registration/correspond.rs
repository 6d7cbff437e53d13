//! The first of the two alternating problems: each point's foot on the offset surface under a given pose.

use nalgebra::Vector6;
use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::lanes::{LANES, Lane, Lane3, side_by_side};
use crate::surface::{Foot, OffsetSurface, Place};

use super::PointStatus;
use super::linearize::{FourSums, Lever, Sums};
use super::robust::ScaledLoss;

/// Points a task takes at a time: long enough to hide the cost of a task, short enough to share out.
const CHUNK: usize = 512;

/// How a centre becomes a distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Reading {
    /// Subtracted from every distance: the probe radius where it was not put into the surface.
    pub(crate) subtract_mm: f64,
    /// What a distance counts for.
    pub(crate) loss: ScaledLoss,
}

/// What is remembered of a measured point from one iteration to the next.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Track {
    pub(crate) place: Place,
    pub(crate) distance_mm: f64,
    /// How far beyond the edge, in steps of the sampling.
    pub(crate) beyond_steps: f32,
    /// Whether the point takes part in the fit.
    pub(crate) used: bool,
}

impl Track {
    /// Returns what became of the point.
    pub(crate) fn status(&self) -> PointStatus {
        match self.used {
            true => PointStatus::Used,
            false if self.beyond_steps > 0.5 => PointStatus::OffPart,
            false => PointStatus::Outlier,
        }
    }

    pub(crate) const NEW: Self = Self { place: Place::UNKNOWN, distance_mm: 0.0, beyond_steps: 0.0, used: true };
}

/// Finds the feet of all points under a pose and sums the linear problem at them.
///
/// Work is shared between threads in chunks whose sums are added in order, so that the result does not depend on how many
/// threads there are; nor does it depend on the vector instructions of the machine, which are chosen as it runs.
pub(crate) fn correspond(
    surface: &OffsetSurface,
    reading: &Reading,
    measured: &[Point],
    tracks: &mut [Track],
    cmm_from_model: &Pose,
    lever: &Lever,
) -> Sums {
    let pass = Pass { surface, reading, model_from_cmm: cmm_from_model.inverse(), lever };
    let arch = pulp::Arch::new();
    let task = |(points, tracks)| arch.dispatch(Chunk { pass: &pass, points, tracks });
    if measured.len() <= 2 * CHUNK {
        return task((measured, tracks));
    }
    let parts: Vec<Sums> = measured.par_chunks(CHUNK).zip(tracks.par_chunks_mut(CHUNK)).map(task).collect();
    parts.iter().fold(Sums::zero(), Sums::merge)
}

/// The work of one task, in a form that is compiled once for each set of vector instructions.
struct Chunk<'a> {
    pass: &'a Pass<'a>,
    points: &'a [Point],
    tracks: &'a mut [Track],
}

impl pulp::NullaryFnOnce for Chunk<'_> {
    type Output = Sums;

    // Inlined into the caller that has the instructions; a call from it would be to code without them.
    #[inline(always)]
    fn call(self) -> Sums {
        self.pass.chunk(self.points, self.tracks)
    }
}

/// One pass over the points: everything that is the same for all of them.
struct Pass<'a> {
    surface: &'a OffsetSurface<'a>,
    reading: &'a Reading,
    model_from_cmm: Pose,
    lever: &'a Lever,
}

impl Pass<'_> {
    /// Sums one chunk of points: in fours while they stay on their facets, alone where they do not.
    #[inline(always)]
    fn chunk(&self, points: &[Point], tracks: &mut [Track]) -> Sums {
        let mut sums = Sums::zero();
        let mut fours = FourSums::zero();
        let mut last = Place::UNKNOWN;
        let warm = self.surface.has_warm_feet();
        let (four_points, rest_points) = points.as_chunks::<LANES>();
        let (four_tracks, rest_tracks) = tracks.as_chunks_mut::<LANES>();
        for (points, tracks) in four_points.iter().zip(four_tracks) {
            let known = tracks[0].place != Place::UNKNOWN;
            if !(warm && known && self.four(points, tracks, &mut fours)) {
                for (point, track) in points.iter().zip(tracks) {
                    self.one(point, track, &mut last, &mut sums);
                }
            }
        }
        for (point, track) in rest_points.iter().zip(rest_tracks) {
            self.one(point, track, &mut last, &mut sums);
        }
        fours.add_to(&mut sums);
        sums
    }

    /// Takes four points that stay on their facets and all take part; returns false, with nothing done, for any others.
    #[inline(always)]
    fn four(&self, points: &[Point; LANES], tracks: &mut [Track; LANES], sums: &mut FourSums) -> bool {
        let p = self.in_model(&side_by_side(points));
        let feet = self.surface.warm_feet(&p, &[tracks[0].place, tracks[1].place, tracks[2].place, tracks[3].place]);
        if feet.stays != [true; LANES] || self.surface.nominal().outline().is_some() {
            return false;
        }
        let distance = feet.distance_mm - Lane::splat(self.reading.subtract_mm);
        let (mut weight, mut loss, mut used) = ([0.0; LANES], [0.0; LANES], 0);
        for l in 0..LANES {
            tracks[l].distance_mm = distance.0[l];
            tracks[l].beyond_steps = 0.0;
            if tracks[l].used {
                (weight[l], loss[l]) = self.reading.loss.weigh(distance.0[l]);
                used += 1;
            }
        }
        sums.add(&self.lever.four_rows(&p, &feet.normal), distance, Lane(weight), Lane(loss), used);
        true
    }

    #[inline(always)]
    fn in_model(&self, w: &Lane3) -> Lane3 {
        let (r, t) = (&self.model_from_cmm.rotation, &self.model_from_cmm.translation_mm);
        let row = |k: usize| {
            let part = |c: usize| Lane::splat(r[(k, c)]) * w[c];
            part(0) + part(1) + part(2) + Lane::splat(t[k])
        };
        [row(0), row(1), row(2)]
    }

    #[inline]
    fn one(&self, point: &Point, track: &mut Track, last: &mut Place, sums: &mut Sums) {
        let p = self.model_from_cmm.point(point); // g^-1 Y
        // A point without a past begins where its neighbour in the file ended, if it has one.
        let start = if track.place == Place::UNKNOWN { *last } else { track.place };
        let foot = self.surface.foot(&p, start);
        *last = foot.place;
        track.place = foot.place;
        track.distance_mm = foot.distance_mm - self.reading.subtract_mm;
        track.beyond_steps = foot.beyond_steps as f32;
        if let Some(outline) = self.surface.nominal().outline() {
            let contact = p - foot.normal * (foot.distance_mm + self.surface.radius_mm());
            if !outline.contains(contact.x, contact.y) {
                track.beyond_steps = track.beyond_steps.max(1.0);
            }
        }
        if track.used {
            let (weight, loss) = self.reading.loss.weigh(track.distance_mm);
            sums.add(&self.lever.row(&p, &foot.normal), track.distance_mm, weight, loss);
        }
    }
}

/// A measured point at the end: its foot, and the row of A there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Final {
    pub(crate) centre: Point,
    pub(crate) foot: Foot,
    pub(crate) row: Vector6<f64>,
}

/// Finds the feet once more and makes of each what is to be reported; nothing else of them is kept.
pub(crate) fn at_feet<T: Send>(
    surface: &OffsetSurface,
    measured: &[Point],
    tracks: &[Track],
    cmm_from_model: &Pose,
    lever: &Lever,
    report: impl Fn(&Track, Final) -> T + Sync,
) -> Vec<T> {
    let model_from_cmm = cmm_from_model.inverse();
    measured
        .par_iter()
        .zip(tracks)
        .with_min_len(CHUNK)
        .map(|(point, track)| {
            let centre = model_from_cmm.point(point);
            let foot = surface.foot(&centre, track.place);
            let row = Vector6::from(lever.row(&centre, &foot.normal));
            report(track, Final { centre, foot, row })
        })
        .collect()
}

/// Returns the middle of a cloud and its rms distance from it.
pub(crate) fn middle_and_size(points: &[Point]) -> (Point, f64) {
    let n = points.len() as f64;
    // In chunks that are added in order: the same bits on any number of threads.
    let parts: Vec<Vector> = points.par_chunks(1 << 14).map(|c| c.iter().map(|p| p.coords).sum()).collect();
    let middle = Point::from(parts.iter().sum::<Vector>() / n);
    let square = |c: &[Point]| c.iter().map(|p| (p - middle).norm_squared()).sum::<f64>();
    let parts: Vec<f64> = points.par_chunks(1 << 14).map(square).collect();
    (middle, (parts.iter().sum::<f64>() / n).sqrt())
}
