//! What is carried to a machine and what comes back.

use regrind_core::geometry::Grid;
use regrind_formats::result::Coordinates;

/// Something that is carried as one string of bytes and known by the SHA-256 of it.
pub trait Identified {
    /// The SHA-256 of the payload's bytes, high words first, whatever the order on the wire.
    fn identity(&self) -> [u8; 32];
}

/// What a target belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u16)]
pub enum TargetKind {
    /// The part.
    Part = 1,
    /// The reference sphere.
    ReferenceSphere = 2,
}

/// One point to be probed, in the CMM's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// Its number, which comes back with the measured point.
    pub index: u32,
    /// What it belongs to.
    pub what: TargetKind,
    /// The nominal contact point.
    pub point_mm: [f64; 3],
    /// The outward unit normal there.
    pub normal: [f64; 3],
}

/// A measuring plan: what a CMM is to probe, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The targets, in the order in which they are probed.
    pub targets: Vec<Target>,
    /// The radius of the probe the plan is made for.
    pub probe_radius_mm: f64,
    /// How far from the point, ball surface, the probe turns into the normal.
    pub approach_mm: f64,
    /// How far beyond the point it searches.
    pub search_mm: f64,
    /// The probing speed.
    pub speed_mm_s: f64,
    /// How far above the highest target, along z of the CMM, the probe travels.
    pub safe_height_mm: f64,
    /// How the plan begins where the part may lie elsewhere than it should; none where it lies as it was found before.
    pub careful: Option<Careful>,
}

/// A careful beginning of a plan: few targets, and slowly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Careful {
    /// So many of the first targets are touched slowly.
    pub targets: u32,
    /// The probing speed for them, and that of every way to them and between them.
    pub speed_mm_s: f64,
}

/// A correction map: by how much the ground surface is wanted displaced along the outward normal of the nominal surface. Positive leaves
/// material. It is absolute: it replaces the one before.
#[derive(Debug, Clone, PartialEq)]
pub struct CorrectionMap {
    /// Where its nodes are, in the model frame.
    pub grid: Grid,
    /// One for each node.
    pub values_mm: Vec<f64>,
    /// The identity of the part's nominal surface.
    pub part_identity: [u8; 32],
}

/// How a pass is ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pass {
    /// Passes without in-feed at the end.
    pub spark_out_passes: u16,
    /// The radius of the wheel.
    pub wheel_radius_mm: f64,
    /// The feed.
    pub feed_mm_min: f64,
    /// From track to track.
    pub track_spacing_mm: f64,
    /// The height of the surface wanted, over the nominal, along the normal.
    pub level_mm: f64,
    /// The most that may be taken off anywhere.
    pub depth_of_cut_mm: f64,
    /// Least and most x of the part, in the model frame.
    pub x_mm: [f64; 2],
    /// Least and most y of the part, in the model frame.
    pub y_mm: [f64; 2],
    /// The identity of the part's nominal surface.
    pub part_identity: [u8; 32],
}

/// What became of a target.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PointStatus {
    /// The probe touched; the coordinates hold.
    Touched,
    /// The probe searched and touched nothing.
    NotFound,
    /// The probe could not get there.
    NotReached,
}

/// One measured point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPoint {
    /// The number of its target.
    pub index: u32,
    /// What became of it.
    pub status: PointStatus,
    /// 0 good to 100 bad.
    pub quality: u16,
    /// In the CMM's frame; of the probe's centre or of the contact, as the measurement says. Means nothing unless touched.
    pub at_mm: [f64; 3],
}

/// What a CMM measured: a point for every target, in the order of the plan.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// The points.
    pub points: Vec<MeasuredPoint>,
    /// What their coordinates are.
    pub coordinates: Coordinates,
    /// The radius of the probe that was used, where that is told.
    pub probe_radius_mm: Option<f64>,
    /// Mean temperature of the part during the job, where that is told.
    pub temperature_c: Option<f64>,
    /// How long the job took, where that is told.
    pub duration_s: Option<f64>,
    /// The identity of the plan that was used.
    pub plan_identity: [u8; 32],
    /// The job it belongs to.
    pub job: u32,
    /// The cycle it belongs to.
    pub cycle: u16,
    /// The number to acknowledge it by.
    pub done: u32,
}

/// Points that a CMM gives while it still measures: to be looked at, and never judged by. What counts is the [`Measurement`] at the end.
#[derive(Debug, Clone, PartialEq)]
pub struct Preliminary {
    /// Whose they are.
    pub job: super::Job,
    /// How many points of the job were told before these; 0 where it begins anew, and what was told before is to be forgotten.
    pub from: usize,
    /// The points, in the order of the plan.
    pub points: Vec<MeasuredPoint>,
    /// What their coordinates are.
    pub coordinates: Coordinates,
}

/// What a grinder, or the person who serves it, says of a pass; `None` is what nobody told.
#[derive(Debug, Clone, PartialEq)]
pub struct PassRecord {
    /// How the job ended.
    pub outcome: super::Outcome,
    /// Path travelled.
    pub path_mm: Option<f64>,
    /// Volume removed.
    pub removed_mm3: Option<f64>,
    /// Largest depth taken off.
    pub deepest_mm: Option<f64>,
    /// Share of the path that cut nothing, 0 to 1.
    pub idle_share: Option<f64>,
    /// Mean spindle load, 1 is full.
    pub spindle_load: Option<f64>,
    /// Radius of the wheel in use.
    pub wheel_radius_mm: Option<f64>,
    /// Mean temperature of the part during the job.
    pub temperature_c: Option<f64>,
    /// How long the job took.
    pub duration_s: Option<f64>,
    /// The identity of the map that was used.
    pub map_identity: [u8; 32],
    /// The job it belongs to.
    pub job: u32,
    /// The cycle it belongs to.
    pub cycle: u16,
    /// The number to acknowledge it by.
    pub done: u32,
}

impl PassRecord {
    /// The record of a pass of which nobody measured anything.
    pub(super) fn unmeasured(outcome: super::Outcome, map_identity: [u8; 32], job: super::Job, done: u32) -> Self {
        Self {
            outcome,
            path_mm: None,
            removed_mm3: None,
            deepest_mm: None,
            idle_share: None,
            spindle_load: None,
            wheel_radius_mm: None,
            temperature_c: None,
            duration_s: None,
            map_identity,
            job: job.job,
            cycle: job.cycle,
            done,
        }
    }
}
