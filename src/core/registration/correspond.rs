//! The first of the two alternating problems: each point's foot on the offset surface under a given pose.

use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::lanes::{FourFeet, LANES, Lane, Lane3, side_by_side};
use crate::surface::{OffsetSurface, Place};

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
    /// Sums one chunk of points: in fours where they stay on their facets or find new ones together, alone elsewhere.
    #[inline(always)]
    fn chunk(&self, points: &[Point], tracks: &mut [Track]) -> Sums {
        let mut sums = Sums::zero();
        let mut fours = FourSums::zero();
        let mut last = Place::UNKNOWN;
        let mut recent = [[Place::UNKNOWN; LANES]; 2];
        let in_fours = self.surface.has_four_feet() && self.surface.nominal().outline().is_none();
        let (four_points, rest_points) = points.as_chunks::<LANES>();
        let (four_tracks, rest_tracks) = tracks.as_chunks_mut::<LANES>();
        for (points, tracks) in four_points.iter().zip(four_tracks) {
            // No closure around what is to be compiled with the vector instructions: it would be compiled without them.
            let start = if in_fours { self.start(tracks, &recent) } else { None };
            let taken = match start {
                Some(places) => self.four(points, tracks, places, &mut fours),
                None => false,
            };
            if !taken {
                for (point, track) in points.iter().zip(&mut *tracks) {
                    self.one(point, track, &mut last, &mut sums);
                }
            }
            recent = [recent[1], [tracks[0].place, tracks[1].place, tracks[2].place, tracks[3].place]];
            last = tracks[LANES - 1].place;
        }
        for (point, track) in rest_points.iter().zip(rest_tracks) {
            self.one(point, track, &mut last, &mut sums);
        }
        fours.add_to(&mut sums);
        sums
    }

    /// Where four points were, or may be expected after those before them; `None` where nothing tells.
    #[inline(always)]
    fn start(&self, tracks: &[Track; LANES], recent: &[[Place; LANES]; 2]) -> Option<[Place; LANES]> {
        let places = [tracks[0].place, tracks[1].place, tracks[2].place, tracks[3].place];
        if !places.contains(&Place::UNKNOWN) {
            return Some(places);
        }
        self.surface.four_places_ahead(&recent[0], &recent[1])
    }

    /// Takes four points that are on the part, near the places given; returns false, with nothing done, for any others.
    #[inline(always)]
    fn four(
        &self,
        points: &[Point; LANES],
        tracks: &mut [Track; LANES],
        mut places: [Place; LANES],
        sums: &mut FourSums,
    ) -> bool {
        let p = four_moved(&self.model_from_cmm, &side_by_side(points));
        let Some(feet) = self.surface.four_feet(&p, &mut places) else { return false };
        let distance = feet.distance_mm - Lane::splat(self.reading.subtract_mm);
        let (mut weight, mut loss, mut used) = ([0.0; LANES], [0.0; LANES], 0);
        for l in 0..LANES {
            tracks[l].place = places[l];
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

/// Four points moved by a pose.
#[inline(always)]
fn four_moved(pose: &Pose, w: &Lane3) -> Lane3 {
    let (r, t) = (&pose.rotation, &pose.translation_mm);
    let row = |k: usize| {
        let part = |c: usize| Lane::splat(r[(k, c)]) * w[c];
        part(0) + part(1) + part(2) + Lane::splat(t[k])
    };
    [row(0), row(1), row(2)]
}

/// Four measured points at the end: their feet, and the rows of A there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FourFinal {
    pub(crate) centre: Lane3,
    pub(crate) feet: FourFeet,
    pub(crate) row: [Lane; 6],
}

/// Makes of four points at their feet what is to be reported of each.
pub(crate) trait Report: Sync {
    /// What is reported of one point.
    type Item: Copy + Send;

    /// Nothing reported yet.
    const BLANK: Self::Item;

    /// Returns what is reported of each of four points. Inlined, so that it is compiled with the caller's instructions.
    fn four(&self, tracks: [&Track; LANES], at: &FourFinal) -> [Self::Item; LANES];
}

/// Fours that a task of [`at_feet`] takes at a time.
const FOURS: usize = 8;

/// Finds the feet once more and makes of each what is to be reported; nothing else of them is kept.
pub(crate) fn at_feet<R: Report>(
    surface: &OffsetSurface,
    measured: &[Point],
    tracks: &[Track],
    cmm_from_model: &Pose,
    lever: &Lever,
    report: &R,
) -> Vec<R::Item> {
    let at_end = AtEnd { surface, measured, tracks, model_from_cmm: cmm_from_model.inverse(), lever, report };
    let arch = pulp::Arch::new();
    // Whole blocks, written where they stay; the last is filled up with the last point.
    let blocks: Vec<[[R::Item; LANES]; FOURS]> = (0..measured.len().div_ceil(LANES * FOURS))
        .into_par_iter()
        .with_min_len(CHUNK / (LANES * FOURS))
        .map(|block| arch.dispatch(EndBlock { at_end: &at_end, block }))
        .collect();
    let mut items = blocks.into_flattened().into_flattened();
    items.truncate(measured.len());
    items
}

/// What is the same for all points at the end.
struct AtEnd<'a, R> {
    surface: &'a OffsetSurface<'a>,
    measured: &'a [Point],
    tracks: &'a [Track],
    model_from_cmm: Pose,
    lever: &'a Lever,
    report: &'a R,
}

struct EndBlock<'a, R> {
    at_end: &'a AtEnd<'a, R>,
    block: usize,
}

impl<R: Report> pulp::NullaryFnOnce for EndBlock<'_, R> {
    type Output = [[R::Item; LANES]; FOURS];

    #[inline(always)]
    fn call(self) -> Self::Output {
        let mut items = [[R::BLANK; LANES]; FOURS];
        for (four, items) in items.iter_mut().enumerate() {
            *items = self.at_end.four((self.block * FOURS + four) * LANES);
        }
        items
    }
}

impl<R: Report> AtEnd<'_, R> {
    /// The four points from one on; past the end the last one again.
    #[inline(always)]
    fn four(&self, first: usize) -> [R::Item; LANES] {
        let end = self.measured.len() - 1;
        let (a, b, c, d) = (first.min(end), (first + 1).min(end), (first + 2).min(end), (first + 3).min(end));
        let tracks = [&self.tracks[a], &self.tracks[b], &self.tracks[c], &self.tracks[d]];
        let points = [self.measured[a], self.measured[b], self.measured[c], self.measured[d]];
        let centre = four_moved(&self.model_from_cmm, &side_by_side(&points));
        let mut places = [tracks[0].place, tracks[1].place, tracks[2].place, tracks[3].place];
        let together = self.surface.has_four_feet() && !places.contains(&Place::UNKNOWN);
        let feet = match if together { self.surface.four_feet(&centre, &mut places) } else { None } {
            Some(feet) => feet,
            None => self.four_single(&centre, tracks),
        };
        self.report.four(tracks, &FourFinal { centre, feet, row: self.lever.four_rows(&centre, &feet.normal) })
    }

    /// The feet of four points that were searched for one by one.
    #[cold]
    fn four_single(&self, centre: &Lane3, tracks: [&Track; LANES]) -> FourFeet {
        let foot = |l: usize| {
            let p = Point::new(centre[0].0[l], centre[1].0[l], centre[2].0[l]);
            self.surface.foot(&p, tracks[l].place)
        };
        let feet: [_; LANES] = std::array::from_fn(foot);
        FourFeet {
            distance_mm: Lane(feet.map(|f| f.distance_mm)),
            normal: [0, 1, 2].map(|c| Lane(feet.map(|f| f.normal[c]))),
        }
    }
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
