//! Plan of the cell: the parameters by which it decides, with its time limits.

use std::time::Duration;

use crate::cell::{CellPlan, Deadlines, GateLimits, HoldOrStop, Tolerance};
use crate::config::{CellConfig, LinkConfig};
use crate::device::LineAddress;
use crate::recipe::{Micrometres, Recipe};

/// Timeout of a job of a machine that a person serves without a wire.
const MANUAL_JOB_TIMEOUT: Duration = Duration::from_secs(7 * 86_400);
/// Timeout for a person to hold or to stop a machine and to confirm it.
const MANUAL_STOP_TIMEOUT: Duration = Duration::from_secs(600);
/// Timeout of an answer of the driver of a machine without a wire, for example from a folder on another computer. It
/// includes the time to read a large file.
const MANUAL_ANSWER_TIMEOUT: Duration = Duration::from_secs(90);
/// Factor between the timeout of a transfer and its duration without faults.
const TRANSFER_TIMEOUT_FACTOR: f64 = 3.0;

pub(super) fn cell_plan(recipe: &Recipe, cell: &CellConfig) -> CellPlan {
    // A job by a person can take days. During a hold the cell keeps waiting.
    let mut deadlines = Deadlines::default();
    let by_person = [&cell.cmm.link, &cell.grinder.link].map(|link| link.wire.is_by_person());
    for k in (0..2).filter(|k| by_person[*k]) {
        (deadlines.progress[k], deadlines.hold[k], deadlines.stop[k]) =
            (MANUAL_JOB_TIMEOUT, MANUAL_STOP_TIMEOUT, MANUAL_STOP_TIMEOUT);
        deadlines.progress_notice[k] = None;
        (deadlines.answer, deadlines.connect) = (MANUAL_ANSWER_TIMEOUT, MANUAL_ANSWER_TIMEOUT);
    }
    CellPlan {
        begin_with: recipe.cycle.begin_with,
        max_cycles: u32::from(recipe.cycle.max_cycles),
        tolerance: tolerance(recipe),
        stall_share: 0.02,
        stall_mm: recipe.cycle.stall_um.mm(),
        on_stall: recipe.cycle.on_stall,
        on_divergence: recipe.cycle.on_divergence,
        on_refusal: HoldOrStop::Stop,
        gates: GateLimits {
            min_found_share: recipe.measure.min_coverage,
            min_coverage: recipe.registration.min_coverage,
            max_shift_mm: recipe.registration.max_shift_mm,
            max_rotation_rad: recipe.registration.max_turn_deg.to_radians(),
            max_radius_error_mm: recipe.measure.qualify.then_some(recipe.measure.radius_tolerance_um.mm()),
        },
        removal_budget_mm: recipe.compensation.removal_budget_um.mm(),
        min_depth_mm: recipe.compensation.min_depth_um.mm(),
        clear_at_start: cell.simulated,
        deadlines,
    }
}

/// Returns the acceptance criteria of the recipe: the limits of PV and RMS in mm, and how the figures are compared with
/// them. A limit that the recipe does not state is infinite.
pub(super) fn tolerance(recipe: &Recipe) -> Tolerance {
    let limit = |um: Option<Micrometres>| um.map_or(f64::INFINITY, Micrometres::mm);
    Tolerance {
        pv_mm: limit(recipe.acceptance.pv_um),
        rms_mm: limit(recipe.acceptance.rms_um),
        with_uncertainty: recipe.acceptance.expanded_uncertainty,
        probability: recipe.required_probability(),
        pv_points: recipe.acceptance.pv_of,
    }
}

/// Returns the timeout for the transfer of `bytes` bytes to a machine on a serial Modbus line (RTU). The timeout is
/// three times the transfer time that follows from the baud rate and the number of bytes. The factor of three allows
/// for retries. Returns zero for every other kind of connection, including Modbus TCP.
pub(super) fn transfer_timeout(link: &LinkConfig, bytes: usize) -> Duration {
    let Some((LineAddress::Rtu { baud, .. }, _)) = link.wire.modbus_line() else { return Duration::ZERO };
    // A page has 224 bytes of data in a frame of 249 and a response of 8. The machine needs some time for each page.
    let pages = bytes.div_ceil(224) as f64;
    let page_s = (249.0 + 8.0) * 11.0 / f64::from(baud.max(1)) + 0.05;
    Duration::from_secs_f64(TRANSFER_TIMEOUT_FACTOR * pages * page_s)
}
