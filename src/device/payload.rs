//! Payloads that are sent to a machine, and results that it returns.

use regrind_core::geometry::Grid;
use regrind_formats::result::Coordinates;

/// Payload that is sent as one string of bytes and identified by its SHA-256.
pub trait Identified {
    /// Returns the identity of the payload: the SHA-256 of its bytes with the high word and the high byte of each value
    /// first. The identity does not depend on the word order of the machine.
    fn identity(&self) -> [u8; 32];
}

/// Object to which a target belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u16)]
pub enum TargetKind {
    /// The part.
    Part = 1,
    /// The reference sphere.
    ReferenceSphere = 2,
}

/// Point to be probed, in the frame of the CMM.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanTarget {
    /// Number of the target, which the measured point repeats.
    pub index: u32,
    /// Object to which it belongs.
    pub kind: TargetKind,
    /// Nominal contact point, in mm.
    pub point_mm: [f64; 3],
    /// Outward unit normal at this point.
    pub normal: [f64; 3],
}

/// Measuring plan: the targets that a CMM probes, and the parameters of probing.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Targets, in the order in which they are probed.
    pub targets: Vec<PlanTarget>,
    /// Radius of the probe for which the plan is made, in mm.
    pub probe_radius_mm: f64,
    /// Distance between the target point and the surface of the probe ball, in mm, from which the probe moves along the
    /// normal.
    pub approach_mm: f64,
    /// Search distance beyond the point, in mm.
    pub search_mm: f64,
    /// Probing speed, in mm/s.
    pub speed_mm_s: f64,
    /// Height above the highest target, along z of the CMM, at which the probe travels, in mm.
    pub safe_height_mm: f64,
    /// Careful beginning of the plan, if the part may not lie where it should. `None` if the part lies where it was
    /// found before.
    pub careful_start: Option<CarefulStart>,
}

/// Careful beginning of a plan: a few targets at low speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarefulStart {
    /// Number of first targets that are probed slowly.
    pub target_count: u32,
    /// Speed in mm/s for probing these targets and for all travel to them and between them.
    pub speed_mm_s: f64,
}

/// Correction map: desired displacement of the ground surface along the outward normal of the nominal surface. Positive
/// values leave material. The map is absolute: it replaces the previous map.
#[derive(Debug, Clone, PartialEq)]
pub struct CorrectionMap {
    /// Grid of the nodes, in the model frame.
    pub grid: Grid,
    /// Displacement at each node, in mm.
    pub values_mm: Vec<f64>,
    /// Identity of the nominal surface of the part.
    pub part_identity: [u8; 32],
}

/// Parameters of a pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pass {
    /// Number of passes without in-feed at the end.
    pub spark_out_passes: u16,
    /// Radius of the wheel, in mm.
    pub wheel_radius_mm: f64,
    /// Feed, in mm/min.
    pub feed_mm_min: f64,
    /// Distance from track to track, in mm.
    pub track_spacing_mm: f64,
    /// Height of the target surface above the nominal surface, along the normal, in mm.
    pub level_mm: f64,
    /// Maximum depth of cut anywhere, in mm.
    pub depth_of_cut_mm: f64,
    /// Minimum and maximum x of the part, in the model frame, in mm.
    pub x_mm: [f64; 2],
    /// Minimum and maximum y of the part, in the model frame, in mm.
    pub y_mm: [f64; 2],
    /// Identity of the nominal surface of the part.
    pub part_identity: [u8; 32],
}

/// Result of probing a target.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TouchStatus {
    /// The probe touched; the coordinates are valid.
    Touched,
    /// The probe searched and touched nothing.
    NotFound,
    /// The probe could not reach the target.
    NotReached,
}

/// Measured point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPoint {
    /// Number of its target.
    pub index: u32,
    /// Result of probing the target.
    pub status: TouchStatus,
    /// Quality from 0 (good) to 100 (bad).
    pub quality: u16,
    /// Position in the frame of the CMM, in mm: centre of the probe or contact point, as [`Measurement::coordinates`]
    /// states. Meaningless unless touched.
    pub position_mm: [f64; 3],
}

/// Measurement of a CMM: one point for every target, in the order of the plan.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// Measured points.
    pub points: Vec<MeasuredPoint>,
    /// Meaning of the coordinates: probe centres or contact points.
    pub coordinates: Coordinates,
    /// Radius of the probe that was used in mm, if reported.
    pub probe_radius_mm: Option<f64>,
    /// Mean temperature of the part during the job in °C, if reported.
    pub temperature_c: Option<f64>,
    /// Duration of the job in s, if reported.
    pub duration_s: Option<f64>,
    /// Identity of the plan that was used.
    pub plan_identity: [u8; 32],
    /// Job to which it belongs.
    pub job: u32,
    /// Cycle to which it belongs.
    pub cycle: u16,
    /// Number with which to acknowledge it.
    pub done: u32,
}

/// Preliminary points that a CMM reports while it still measures. They are for display and never for judgement; only
/// the final [`Measurement`] counts.
#[derive(Debug, Clone, PartialEq)]
pub struct PreliminaryPoints {
    /// Job to which they belong.
    pub job: super::Job,
    /// Number of points of the job that were reported before these. 0 if the report starts again; then discard all
    /// earlier points.
    pub first_index: usize,
    /// Points, in the order of the plan.
    pub points: Vec<MeasuredPoint>,
    /// Meaning of the coordinates: probe centres or contact points.
    pub coordinates: Coordinates,
}

/// Record of a pass, from the grinder or from its operator. `None` marks a value that nobody reported.
#[derive(Debug, Clone, PartialEq)]
pub struct PassRecord {
    /// Outcome of the job.
    pub outcome: super::Outcome,
    /// Path travelled, in mm.
    pub path_mm: Option<f64>,
    /// Volume removed, in mm³.
    pub removed_mm3: Option<f64>,
    /// Largest depth removed, in mm.
    pub max_depth_mm: Option<f64>,
    /// Fraction of the path on which the wheel removed no material, from 0 to 1.
    pub idle_share: Option<f64>,
    /// Mean spindle load; 1 is full load.
    pub spindle_load: Option<f64>,
    /// Radius of the wheel in use, in mm.
    pub wheel_radius_mm: Option<f64>,
    /// Mean temperature of the part during the job, in °C.
    pub temperature_c: Option<f64>,
    /// Duration of the job, in s.
    pub duration_s: Option<f64>,
    /// Identity of the map that was used.
    pub map_identity: [u8; 32],
    /// Job to which it belongs.
    pub job: u32,
    /// Cycle to which it belongs.
    pub cycle: u16,
    /// Number with which to acknowledge it.
    pub done: u32,
}

impl PassRecord {
    /// Returns the record of a pass that ended with `outcome` and for which the machine measured no values. Every
    /// measured value, such as the removed volume, is `None`. `map_identity` is the SHA-256 of the correction map, and
    /// `done` is the sequence number of the START that began `job`.
    pub(super) fn unmeasured(outcome: super::Outcome, map_identity: [u8; 32], job: super::Job, done: u32) -> Self {
        Self {
            outcome,
            path_mm: None,
            removed_mm3: None,
            max_depth_mm: None,
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
