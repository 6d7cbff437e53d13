//! Reference solution of a registration, computed independently from the world's truth.
//!
//! The measurand is the pose, and the map of deviations, that best fit the *true* surface at the *measured* places: the
//! form error itself moves a best fit, and no measurement can undo that. The true centre of a ball on the real surface
//! is therefore computed over the projection of every measured centre, without noise. The pose is the exact
//! least-squares pose, found by Newton's method on the closed form with independent projections. This code shares
//! nothing with the library except the type of a pose.

use nalgebra::{Matrix6, Vector6};
use regrind::geometry::{Pose, Twist};
use regrind_sim::Vec3;
use regrind_sim::probe::Placement;
use regrind_sim::world::World;

use crate::worlds::{Snapshot, project_onto_nominal};

/// Best fit to the true surface.
pub struct Truth {
    /// Pose that transforms the model frame to the CMM's frame.
    pub pose: Pose,
    /// Deviation at each measured position, minus the level, in mm.
    pub deviations_mm: Vec<f64>,
}

impl Truth {
    /// Returns the maximum minus the minimum deviation, in mm.
    pub fn pv_mm(&self) -> f64 {
        let (low, high) = self.deviations_mm.iter().fold((f64::MAX, f64::MIN), |(l, h), d| (l.min(*d), h.max(*d)));
        high - low
    }

    /// Returns the root mean square of the deviations, in mm.
    pub fn rms_mm(&self) -> f64 {
        (self.deviations_mm.iter().map(|d| d * d).sum::<f64>() / self.deviations_mm.len() as f64).sqrt()
    }
}

/// Fits the true surface of a cycle at the positions that took part in the registration. The map covers all positions.
pub fn truth(world: &World, seen: &Snapshot, used: &[bool], radius_mm: f64, level_mm: f64) -> Truth {
    let above = |(place, height_mm): (&[f64; 2], &f64)| -> Vec3 {
        let (s, n) = world.nominal(place[0], place[1]);
        seen.placement.apply(std::array::from_fn(|i| s[i] + (radius_mm + height_mm) * n[i]))
    };
    let centres: Vec<Vec3> = seen.places_mm.iter().zip(&seen.heights_mm).map(above).collect();
    let mut pose = pose_of(&seen.placement);
    loop {
        let (mut gram, mut right) = (Matrix6::zeros(), Vector6::zeros());
        let mut deviations_mm = Vec::with_capacity(centres.len());
        for (c, used) in centres.iter().zip(used) {
            let q: Vec3 = pose.inverse().transform_point(&(*c).into()).into();
            let (_, n, distance) = project_onto_nominal(world, q);
            let deviation = distance - radius_mm - level_mm;
            let row = -Vector6::new(
                n[0],
                n[1],
                n[2],
                q[1] * n[2] - q[2] * n[1],
                q[2] * n[0] - q[0] * n[2],
                q[0] * n[1] - q[1] * n[0],
            );
            if *used {
                gram += row * row.transpose();
                right -= row * deviation;
            }
            deviations_mm.push(deviation);
        }
        let step: Twist = gram.lu().solve(&right).expect("the part holds its pose");
        if step.norm() < 1e-9 {
            return Truth { pose, deviations_mm };
        }
        pose = pose * Pose::exp(&step);
    }
}

fn pose_of(placement: &Placement) -> Pose {
    let (r, t) = (&placement.rotation, &placement.translation_mm);
    let row = |i: usize| [r[i][0], r[i][1], r[i][2], t[i]];
    Pose::from_rows([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]).unwrap()
}
