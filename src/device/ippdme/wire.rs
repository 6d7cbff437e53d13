//! Table of the cell file for an I++ DME server, and its driver factory.

use std::time::Duration;

use regrind_document::Document;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::link::Limits;
use super::machine::IppdmeCmm;
use super::settings::{IppdmeSettings, Scanning};
use crate::driver_factory::{ConnectionCheck, DriverContext, DriverError, DriverFactory};
use crate::machine_table::MachineTable;
use crate::network_address::{HostTexts, check_address};
use crate::no_machine::NoMachine;

/// I++ DME over TCP, for a measuring machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct IppdmeWire {
    /// Name or address of the server.
    #[schemars(length(min = 1, max = 253), extend("x-required" = true), example = "192.168.0.20")]
    pub host: String,
    /// Port; 0, in a simulated cell only, selects a free port at the start.
    #[schemars(range(min = 0, max = 65535))]
    pub port: u16,
    /// Name of the tool at the server.
    #[schemars(length(min = 1, max = 80), extend("x-required" = true), example = &"Probe1")]
    pub tool: String,
    /// Maximum difference between the radius that the server reports for its tool, or for a touch, and that of the
    /// recipe.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub probe_tolerance_mm: f64,
    /// Speed of travel between targets; the server may limit it further.
    #[schemars(range(min = 0.1, max = 2000.0))]
    pub travel_speed_mm_s: f64,
    /// Speed of scanning, for a probe that can scan: it moves over rows of targets in contact, and the points at the
    /// targets are reported. Default: every target is touched.
    #[schemars(range(min = 0.1, max = 500.0), example = 10.0)]
    pub scan_speed_mm_s: Option<f64>,
    /// Maximum distance from one target to the next within a scan; targets farther apart are touched.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub scan_step_mm: f64,
    /// Frame of the part, in which the probe is commanded: origin of the machine in it, then theta, psi and phi in
    /// degrees. Default: the frame of the machine.
    #[schemars(inner(range(min = -100000.0, max = 100000.0)), example = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0])]
    pub part_frame: Option<[f64; 6]>,
    /// Number of retries for a missed target.
    #[schemars(range(min = 0, max = 10))]
    pub retries: u8,
    /// Timeout of the connection, and of the acknowledgement of a command.
    #[schemars(range(min = 10, max = 600000))]
    pub answer_timeout_ms: u32,
    /// Timeout of the end of a command, in addition to twice the time of its travel.
    #[schemars(range(min = 10, max = 3600000))]
    pub completion_timeout_ms: u32,
    /// Timeout of the end of an abort.
    #[schemars(range(min = 10, max = 600000))]
    pub abort_timeout_ms: u32,
    /// Interval between two attempts to clear errors after an abort; some servers are not ready at once.
    #[schemars(range(min = 1, max = 60000))]
    pub delay_after_abort_ms: u32,
    /// Silence after which the server is asked whether it is alive.
    #[schemars(range(min = 10, max = 600000))]
    pub alive_every_ms: u32,
}

impl Default for IppdmeWire {
    fn default() -> Self {
        Self {
            host: String::new(),
            port: 1294,
            tool: String::new(),
            probe_tolerance_mm: 0.01,
            travel_speed_mm_s: 100.0,
            scan_speed_mm_s: None,
            scan_step_mm: 5.0,
            part_frame: None,
            retries: 1,
            answer_timeout_ms: 5000,
            completion_timeout_ms: 10_000,
            abort_timeout_ms: 5000,
            delay_after_abort_ms: 250,
            alive_every_ms: 1000,
        }
    }
}

impl DriverFactory for IppdmeWire {
    type Cmm = IppdmeCmm;
    type Grinder = NoMachine;
    const REPORTS_TEMPERATURE: bool = false;
    const CHECK: ConnectionCheck = ConnectionCheck::Session;
    const END_OF_JOB: &'static str = "the server of this machine stores no job, so there is no job to end; check that the probe is clear of the part";

    fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
        if place.table == "grinder" {
            let allowed = "I++ DME is for measuring machines";
            return document.report("grinder.wire.kind", "is \"ippdme\"", allowed, "name another wire");
        }
        let texts = HostTexts {
            allowed: "`host` must be only a name or an address, such as \"192.168.0.20\"",
            remedy: "write the port into the key `port`",
        };
        let usual_port = "the usual port of I++ DME is 1294";
        check_address((&self.host, self.port), (&texts, usual_port), place, document);
        if !document.contains_key("cmm.travel") {
            let allowed = "[cmm.travel] must give the volume of the machine, because Regrind checks every position before the machine moves";
            document.report("cmm.wire.kind", "is \"ippdme\" without [cmm.travel]", allowed, "add min_mm and max_mm");
        }
        if self.tool.contains(['"', '\r', '\n']) || !self.tool.is_ascii() {
            let allowed = "the name of a tool must be plain ASCII without quotes";
            document.report("cmm.wire.tool", format!("is {:?}", self.tool), allowed, "correct it");
        }
        if let Some([_, _, _, theta, ..]) = self.part_frame
            && !(0.0..=180.0).contains(&theta)
        {
            let found = format!("has a theta of {theta}°");
            document.report("cmm.wire.part_frame", found, "theta must be 0° to 180°", "correct its fourth number");
        }
    }

    fn create_cmm(&self, context: &DriverContext<'_>) -> Result<IppdmeCmm, DriverError> {
        let machine = format!("cmm at {}:{}", self.host, self.port);
        let volume_mm = context.volume_mm.ok_or(DriverError::NoVolume { machine })?;
        let ms = |ms: u32| Duration::from_millis(ms.into());
        Ok(IppdmeCmm::new(IppdmeSettings {
            host: self.host.clone(),
            port: self.port,
            tool: self.tool.clone(),
            probe_tolerance_mm: self.probe_tolerance_mm,
            travel_speed_mm_s: self.travel_speed_mm_s,
            scan: self.scan_speed_mm_s.map(|speed_mm_s| Scanning { speed_mm_s, step_mm: self.scan_step_mm }),
            part_frame: self.part_frame,
            retries: self.retries,
            volume_mm,
            limits: Limits {
                answer: ms(self.answer_timeout_ms),
                completion: ms(self.completion_timeout_ms),
                abort: ms(self.abort_timeout_ms),
                after_abort: ms(self.delay_after_abort_ms),
                alive: ms(self.alive_every_ms),
            },
            silence_limit: context.timing.lost_after,
            expected_name: context.expected_name.map(str::to_owned),
            simulated: context.simulated,
        }))
    }

    fn create_grinder(&self, _: &DriverContext<'_>) -> Result<NoMachine, DriverError> {
        Err(DriverError::NoDriver { table: "grinder", kind: "ippdme" })
    }

    fn address(&self) -> Option<String> {
        Some(format!("{}:{}", self.host, self.port))
    }

    fn has_open_address(&self) -> bool {
        self.port == 0
    }
}
