//! Checks a cell file as written: converts units and finds contradictions between keys.

use std::path::Path;
use std::time::Duration;

use super::tables::{
    CellFile, FixtureTable, GrinderTable, RotaryTable, RotatedElement, SphereTable, TimingTable, TravelTable,
    UncertaintyTable,
};
use super::{
    CellConfig, CmmConfig, GrinderConfig, GrinderLimits, LinkConfig, ProgramConfig, ReferenceSphere, RotaryConfig,
    TravelLimits, dialect,
};
use crate::device::{MachineTable, RegisterMap, Signal, SignalTable, Timing, Wire};
use crate::document::{Document, sha256};
use crate::formats::gcode::{DialectError, LINUXCNC};
use crate::geometry::{Point, Pose, Twist};
use crate::model;

/// Checked values of a cell without path and text. A field is `None` if a key is missing, which is already reported.
pub(super) struct CheckedCell {
    name: Option<String>,
    simulated: Option<bool>,
    require_signature: bool,
    cmm: Option<CmmConfig>,
    grinder: Option<GrinderConfig>,
}

impl CheckedCell {
    /// Builds the configuration of the cell from the checked values. `path` is the path of the cell file and `text` its
    /// content. `renamed` contains one note for each key that the file has under its old name.
    ///
    /// Returns `None` if a required value is missing or invalid.
    pub(super) fn into_cell(self, path: &Path, text: &str, mut renamed: Vec<String>) -> Option<CellConfig> {
        let grinder = self.grinder?;
        renamed.extend_from_slice(&grinder.program.dialect_renamed_keys);
        Some(CellConfig {
            name: self.name?,
            simulated: self.simulated?,
            rehearsal: false,
            require_signature: self.require_signature,
            cmm: self.cmm?,
            grinder,
            path: path.to_owned(),
            text: text.to_owned(),
            source_sha256: sha256(text),
            renamed,
        })
    }
}

/// Tables that both machines have.
struct MachineTables<'w> {
    key: &'static str,
    wire: Option<&'w Wire>,
    expected_name: Option<&'w String>,
    calibration_due: Option<&'w String>,
    timing: &'w TimingTable,
    registers: Option<&'w RegisterMap>,
    signals: &'w [SignalTable],
}

/// Checks the tables of the cell file `written` and converts their values into the units of [`CellConfig`]. `path` is
/// the path of the cell file; relative paths in the file are resolved against its folder. Adds each error to
/// `document`.
///
/// In the result, a required value with an error is `None`.
pub(super) fn check(written: &CellFile, path: &Path, document: &mut Document) -> CheckedCell {
    let (cmm, grinder) = (&written.cmm, &written.grinder);
    let machines = [
        MachineTables {
            key: "cmm",
            wire: cmm.wire.as_ref(),
            expected_name: cmm.expected_name.as_ref(),
            calibration_due: cmm.calibration_due.as_ref(),
            timing: &cmm.timing,
            registers: cmm.registers.as_ref(),
            signals: &cmm.signals,
        },
        MachineTables {
            key: "grinder",
            wire: grinder.wire.as_ref(),
            expected_name: grinder.expected_name.as_ref(),
            calibration_due: grinder.calibration_due.as_ref(),
            timing: &grinder.timing,
            registers: grinder.registers.as_ref(),
            signals: &grinder.signals,
        },
    ];
    let simulated = written.cell.simulated;
    // A simulated machine beside one that a person serves is a rehearsal. With both served by people nothing is
    // simulated.
    if simulated == Some(true) && machines.iter().all(|m| m.wire.is_some_and(Wire::is_by_person)) {
        let found = "is true, but people operate both machines (by files or by hand)";
        document.report("cell.simulated", found, "a person cannot be simulated", "write `simulated = false`");
    }
    let [cmm_link, grinder_link] = machines.map(|machine| machine.link(simulated, document));
    if let (Some(cmm), Some(grinder)) = (&cmm_link, &grinder_link) {
        cmm.wire.check_against_grinder(&grinder.wire, document);
    }
    let sphere = cmm.reference_sphere.as_ref().map(|sphere| reference_sphere(sphere, cmm.travel.as_ref(), document));
    let travel = cmm.travel.as_ref().map(|travel| self::travel(travel, "cmm", document));
    let limits = limits(grinder, document);
    let program = programming(grinder, path, document);
    // An incomplete table is already reported.
    let rotary = grinder.rotary.as_ref().map(|rotary| self::rotary(rotary, document));
    let complete = !matches!(sphere, Some(None)) && !matches!(travel, Some(None));
    CheckedCell {
        name: written.cell.name.clone(),
        simulated,
        require_signature: written.cell.require_signature,
        cmm: cmm_link.filter(|_| complete).map(|link| CmmConfig {
            link,
            fixture_cmm_from_model: fixture(&cmm.fixture),
            scale_expansion_um_m_k: cmm.temperature.scale_expansion_um_m_k,
            temperature_uncertainty_k: cmm.temperature.uncertainty_k,
            uncertainty: uncertainty(&cmm.uncertainty),
            reference_sphere: sphere.flatten(),
            travel: travel.flatten(),
        }),
        grinder: (grinder_link.zip(limits).zip(program))
            .filter(|_| !matches!(rotary, Some(None)))
            .map(|((link, limits), program)| GrinderConfig { link, limits, program, rotary: rotary.flatten() }),
    }
}

/// Returns true if `text` is a day of the calendar in the form `2027-03-31`.
fn is_day(text: &str) -> bool {
    let fields: Vec<&str> = text.split('-').collect();
    let [year, month, day] = fields[..] else { return false };
    if (year.len(), month.len(), day.len()) != (4, 2, 2) || !text.bytes().all(|b| b.is_ascii_digit() || b == b'-') {
        return false;
    }
    let [year, month, day] = [year, month, day].map(|field| field.parse::<u32>().unwrap_or(0));
    let is_leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let days = match month {
        2 => 28 + u32::from(is_leap),
        4 | 6 | 9 | 11 => 30,
        1..=12 => 31,
        _ => 0,
    };
    (1..=days).contains(&day)
}

impl MachineTables<'_> {
    fn key(&self, rest: &str) -> String {
        format!("{}.{rest}", self.key)
    }

    fn link(&self, simulated: Option<bool>, document: &mut Document) -> Option<LinkConfig> {
        let place = MachineTable { table: self.key, simulated };
        let timing = self.timing(document);
        let registers = self.registers.copied().unwrap_or_default();
        registers.check(&place, document);
        let signals = Signal::from_tables(self.signals, registers.word_order, &place, document);
        let wire = self.wire?;
        wire.check(&place, document);
        if !wire.has_registers() {
            let idle = [("registers", self.registers.is_some()), ("signals", !self.signals.is_empty())];
            for (table, _) in idle.iter().filter(|(_, there)| *there) {
                let found = "is set, but the connection of this machine (`wire`) has no registers";
                document.report(&self.key(table), found, "it would have no effect", "remove it, or change the wire");
            }
        }
        if let Some(due) = self.calibration_due.filter(|due| !is_day(due)) {
            let remedy = "write the day as `calibration_due = \"2027-03-31\"`, or remove the key";
            let found = format!("is {due:?}");
            document.report(&self.key("calibration_due"), found, "a day, such as \"2027-03-31\"", remedy);
        }
        let [expected_name, calibration_due] =
            [self.expected_name, self.calibration_due].map(Option::<&String>::cloned);
        Some(LinkConfig { wire: wire.clone(), timing, registers, signals: signals?, expected_name, calibration_due })
    }

    fn timing(&self, document: &mut Document) -> Timing {
        let written = self.timing;
        let all_tries_ms = written.request_timeout_ms * (u64::from(written.retries) + 1);
        if all_tries_ms > written.lost_after_ms {
            document.report(
                &self.key("timing.lost_after_ms"),
                format!(
                    "is {} ms, but all {} tries of a request, {} ms each, take {all_tries_ms} ms",
                    written.lost_after_ms,
                    u64::from(written.retries) + 1,
                    written.request_timeout_ms
                ),
                "the time must be long enough for all tries",
                "raise `lost_after_ms`, or lower `request_timeout_ms` or `retries`",
            );
        }
        for (name, ms) in [("poll_ms", written.poll_ms), ("heartbeat_ms", written.heartbeat_ms)] {
            if 2 * ms > written.lost_after_ms {
                document.report(
                    &self.key(&format!("timing.{name}")),
                    format!("is {ms} ms, which is more than half of `lost_after_ms` ({} ms)", written.lost_after_ms),
                    "one late poll or heartbeat must not count as a lost machine",
                    "lower it, or raise `lost_after_ms`",
                );
            }
        }
        let ms = Duration::from_millis;
        Timing {
            request_timeout: ms(written.request_timeout_ms),
            retries: written.retries,
            poll: ms(written.poll_ms),
            heartbeat: ms(written.heartbeat_ms),
            lost_after: ms(written.lost_after_ms),
            quarantine: ms(written.quarantine_ms),
        }
    }
}

/// Returns the pose of the part in the fixture: the transformation from model coordinates to CMM coordinates, in
/// millimetres. The table gives rotations in degrees about the fixed axes x, then y, then z of the CMM, and after them
/// a translation in millimetres.
fn fixture(written: &FixtureTable) -> Pose {
    let turn = |axis: usize| {
        let mut twist = Twist::zeros();
        twist[3 + axis] = written.rotation_deg[axis].to_radians();
        Pose::exp(&twist).rotation
    };
    Pose { rotation: turn(2) * turn(1) * turn(0), translation_mm: written.translation_mm.into() }.orthonormalised()
}

fn programming(grinder: &GrinderTable, path: &Path, document: &mut Document) -> Option<ProgramConfig> {
    let written = &grinder.program;
    // LinuxCNC reads only its own dialect and frame.
    if matches!(grinder.wire, Some(Wire::Linuxcnc(_))) {
        if written.dialect != LINUXCNC {
            let found = format!("is {:?} for LinuxCNC", written.dialect);
            document.report("grinder.program.dialect", found, "LinuxCNC reads only its own dialect", "remove it");
        }
        if written.folder.is_some() {
            let found = "is set, but the LinuxCNC driver transfers the program itself";
            document.report("grinder.program.folder", found, "the folder is grinder.wire.programs", "remove it");
        }
    }
    let dialect::DialectFile { dialect, renamed_keys, .. } = match dialect::read_named_dialect(&written.dialect, path) {
        Ok(file) => file,
        Err(problems) => {
            let known = dialect::dialects().collect::<Vec<_>>().join(", ");
            let file = dialect::dialect_path(&written.dialect, path).unwrap_or_default();
            let found =
                format!("is {:?}: {}", written.dialect, problems.to_string().lines().next().unwrap_or_default());
            let remedy = format!(
                "write the name of a known dialect, or correct the dialect file; to check the file: regrind check {}",
                file.display()
            );
            let allowed = format!("it must be one of {known}, or a valid dialect file");
            document.report("grinder.program.dialect", found, &allowed, &remedy);
            return None;
        }
    };
    let arcs_within_mm = written.arcs_within_um.map(|um| 1e-3 * um);
    match arcs_within_mm.map(|mm| dialect.arcs(mm)) {
        Some(Err(DialectError::NoArcs { dialect })) => document.report(
            "grinder.program.arcs_within_um",
            format!("is set, but the dialect `{dialect}` has no commands for arcs"),
            "arcs require [arcs] in the dialect",
            "remove this key, or add the table [arcs] to a dialect file of your own",
        ),
        Some(Err(DialectError::ArcsFine { dialect, found_um, decimals, min_um })) => document.report(
            "grinder.program.arcs_within_um",
            format!("is {found_um} µm"),
            &format!(
                "it must be at least {min_um:.4} µm, the rounding error of the {decimals} decimals of `{dialect}`"
            ),
            "raise arcs_within_um; or, if the control reads more decimals, write a dialect of your own with more \
             decimals",
        ),
        _ => {}
    }
    let in_file = |note| format!("dialect {}, {note}", written.dialect);
    Some(ProgramConfig {
        dialect,
        dialect_renamed_keys: renamed_keys.into_iter().map(in_file).collect(),
        arcs_within_mm,
        controller_tolerance_mm: written.controller_tolerance_um.map(|um| 1e-3 * um),
        folder: written.folder.as_ref().map(|folder| path.parent().unwrap_or(Path::new("")).join(folder)),
    })
}

fn uncertainty(written: &UncertaintyTable) -> model::MachineUncertainty {
    const MILLIONTH: f64 = 1e-6;
    const UM: f64 = 1e-3;
    model::MachineUncertainty {
        scale: written.scale_ppm.map(|ppm| MILLIONTH * ppm),
        squareness_rad: written.squareness_urad.map(|urad| MILLIONTH * urad),
        probe_mm: UM * written.probe_um,
        reference_sphere_mm: UM * written.reference_sphere_um,
    }
}

fn reference_sphere(
    written: &SphereTable,
    travel: Option<&TravelTable>,
    document: &mut Document,
) -> Option<ReferenceSphere> {
    let (centre_mm, radius_mm) = (written.centre_mm?, written.radius_mm?);
    if let Some((least, most)) = travel.and_then(|travel| travel.min_mm.zip(travel.max_mm))
        && (0..3).all(|k| least[k] < most[k])
        && (0..3).any(|k| !(least[k]..=most[k]).contains(&centre_mm[k]))
    {
        let [x, y, z] = centre_mm;
        let found = format!("is [{x}, {y}, {z}], outside [cmm.travel]");
        document.report(
            "cmm.reference_sphere.centre_mm",
            found,
            "the probe must reach the sphere",
            "correct one of them",
        );
    }
    Some(ReferenceSphere { centre: Point::from(centre_mm), radius_mm, points: written.points })
}

fn travel(written: &TravelTable, machine: &str, document: &mut Document) -> Option<TravelLimits> {
    let (min_mm, max_mm) = (written.min_mm?, written.max_mm?);
    for (k, axis) in ["x", "y", "z"].into_iter().enumerate() {
        if min_mm[k] >= max_mm[k] {
            let found = format!("is {} mm in {axis}, but `max_mm` is only {} mm", min_mm[k], max_mm[k]);
            document.report(
                &format!("{machine}.travel.min_mm"),
                found,
                "it must be less than `max_mm`",
                "check whether the two are swapped",
            );
        }
    }
    Some(TravelLimits { min_mm, max_mm })
}

fn rotary(written: &RotaryTable, document: &mut Document) -> Option<RotaryConfig> {
    if written.turns == RotatedElement::Table {
        document.report(
            "grinder.rotary.turns",
            "is \"table\"",
            "the programs of Regrind can tilt only the wheel head, not the machine table with the part",
            "remove the section [grinder.rotary] from the cell file; the wheel then stays upright",
        );
    }
    let (letter, range_deg) = (written.axis?, [written.min_deg?, written.max_deg?]);
    if range_deg[0] >= range_deg[1] {
        document.report(
            "grinder.rotary.min_deg",
            format!("is {}°, and `max_deg` is {}°", range_deg[0], range_deg[1]),
            "it must be less than `max_deg`",
            "check whether the two are swapped",
        );
    }
    let max_rate_deg_min = written.max_rate_deg_min?;
    Some(RotaryConfig { letter, reversed: written.reversed, range_deg, max_rate_deg_min, pivot_mm: written.pivot_mm })
}

fn limits(grinder: &GrinderTable, document: &mut Document) -> Option<GrinderLimits> {
    let written = &grinder.limits;
    let wheel_radius_mm = [written.min_wheel_radius_mm?, written.max_wheel_radius_mm?];
    if wheel_radius_mm[0] > wheel_radius_mm[1] {
        document.report(
            "grinder.limits.min_wheel_radius_mm",
            format!("is {} mm, but `max_wheel_radius_mm` is only {} mm", wheel_radius_mm[0], wheel_radius_mm[1]),
            "no wheel can fit",
            "check whether the two are swapped",
        );
    }
    Some(GrinderLimits {
        max_feed_mm_min: written.max_feed_mm_min?,
        wheel_radius_mm,
        max_depth_mm: written.max_depth_mm?,
        max_speed_mm_s: written.max_speed_mm_s,
        max_acceleration_mm_s2: written.max_acceleration_mm_s2,
        max_jerk_mm_s3: written.max_jerk_mm_s3,
        travel: grinder.travel.as_ref().and_then(|travel| self::travel(travel, "grinder", document)),
    })
}
