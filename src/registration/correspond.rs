//! The first of the two alternating problems: each point's foot on the offset surface under a given pose.

use nalgebra::Vector6;
use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::{Foot, OffsetSurface, Place};

use super::PointStatus;
use super::linearize::{Lever, Sums};
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
/// threads there are.
pub(crate) fn correspond(
    surface: &OffsetSurface,
    reading: &Reading,
    measured: &[Point],
    tracks: &mut [Track],
    cmm_from_model: &Pose,
    lever: &Lever,
) -> Sums {
    let model_from_cmm = cmm_from_model.inverse();
    let task = |(points, tracks): (&[Point], &mut [Track])| {
        let mut sums = Sums::zero();
        let mut last = Place::UNKNOWN;
        for (point, track) in points.iter().zip(tracks) {
            let p = model_from_cmm.point(point); // g^-1 Y
            // A point without a past begins where its neighbour in the file ended, if it has one.
            let start = if track.place == Place::UNKNOWN { last } else { track.place };
            let foot = surface.foot(&p, start);
            last = foot.place;
            track.place = foot.place;
            track.distance_mm = foot.distance_mm - reading.subtract_mm;
            track.beyond_steps = foot.beyond_steps as f32;
            if let Some(outline) = surface.nominal().outline() {
                let contact = p - foot.normal * (foot.distance_mm + surface.radius_mm());
                if !outline.contains(contact.x, contact.y) {
                    track.beyond_steps = track.beyond_steps.max(1.0);
                }
            }
            if track.used {
                let (weight, loss) = reading.loss.weigh(track.distance_mm);
                sums.add(&lever.row(&p, &foot.normal), track.distance_mm, weight, loss);
            }
        }
        sums
    };
    if measured.len() <= 2 * CHUNK {
        return task((measured, tracks));
    }
    let parts: Vec<Sums> = measured.par_chunks(CHUNK).zip(tracks.par_chunks_mut(CHUNK)).map(task).collect();
    parts.iter().fold(Sums::zero(), Sums::merge)
}

/// A measured point at the end: its foot, and the row of A there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Final {
    pub(crate) centre: Point,
    pub(crate) foot: Foot,
    pub(crate) row: Vector6<f64>,
}

/// Finds the feet once more, to be reported.
pub(crate) fn feet(
    surface: &OffsetSurface,
    measured: &[Point],
    tracks: &[Track],
    cmm_from_model: &Pose,
    lever: &Lever,
) -> Vec<Final> {
    let model_from_cmm = cmm_from_model.inverse();
    measured
        .par_iter()
        .zip(tracks)
        .with_min_len(CHUNK)
        .map(|(point, track)| {
            let centre = model_from_cmm.point(point);
            let foot = surface.foot(&centre, track.place);
            let row = Vector6::from(lever.row(&centre, &foot.normal));
            Final { centre, foot, row }
        })
        .collect()
}

/// Returns the middle of a cloud and its rms distance from it.
pub(crate) fn middle_and_size(points: &[Point]) -> (Point, f64) {
    let n = points.len() as f64;
    let middle = Point::from(points.iter().map(|p| p.coords).sum::<Vector>() / n);
    let size_mm = (points.iter().map(|p| (p - middle).norm_squared()).sum::<f64>() / n).sqrt();
    (middle, size_mm)
}
