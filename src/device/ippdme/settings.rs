//! Settings of an I++ DME server in a cell file, and the machine created from them.

use std::sync::Arc;
use std::time::Duration;

use super::link::Limits;

/// Settings that drive an I++ DME server.
#[derive(Clone, Debug)]
pub struct IppdmeSettings {
    /// Name or address of the server.
    pub host: String,
    /// Port of the server.
    pub port: u16,
    /// Name of the tool, as the server calls it.
    pub tool: String,
    /// Maximum difference between the tool radius and the plan's, in mm.
    pub probe_tolerance_mm: f64,
    /// Speed of travel between targets, in mm/s.
    pub travel_speed_mm_s: f64,
    /// Speed and maximum step of scans; `None` if every target is touched.
    pub scan: Option<Scanning>,
    /// Frame of the part; `None` for the machine's own.
    pub part_frame: Option<[f64; 6]>,
    /// Number of retries for a missed target.
    pub retries: u8,
    /// Minimum and maximum corner of the box that the probe's centre must not leave, in mm.
    pub volume_mm: [[f64; 3]; 2],
    /// Timeouts of the session.
    pub limits: Limits,
    /// Time without a status request after which a job holds by itself.
    pub silence_limit: Duration,
    /// Expected name of the machine.
    pub expected_name: Option<String>,
    /// True if the machine must be a simulation, false if it must be real.
    pub simulated: bool,
}

/// Parameters of the scanning of rows of targets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scanning {
    /// Speed along the surface, in mm/s.
    pub speed_mm_s: f64,
    /// Maximum distance from one target to the next, in mm.
    pub step_mm: f64,
}

impl IppdmeSettings {
    pub(super) fn diagonal_mm(&self) -> f64 {
        let [least, most] = self.volume_mm;
        (0..3).map(|k| (most[k] - least[k]).powi(2)).sum::<f64>().sqrt()
    }
}

/// Returns the name of a machine in messages, with its address.
pub(super) fn name(settings: &IppdmeSettings) -> Arc<str> {
    format!("cmm at {}:{} (I++ DME)", settings.host, settings.port).into()
}
