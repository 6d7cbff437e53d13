//! Equipment that made and measured a part, quality of its registration, and the fields for signatures.

use std::fmt::Write;
use std::fs;
use std::io;
use std::path::Path;

use serde_json::Value;

use super::ReportError;
use super::run_history::RunHistory;
use regrind_cell::Device;
use regrind_formats::run_files::CycleFile;
use regrind_formats::{FormatError, escaped};

/// Returns the HTML table of the machines, the wheel and the probe of a run. `story` is the history of the run from its
/// record. `registration` is the content of the newest file `registration.json`, or `None` if there is no such file. A
/// value that is not on record is shown as "not reported".
pub(super) fn equipment(story: &RunHistory, registration: Option<&Value>) -> String {
    let not_told = || "not reported".to_owned();
    let machine = |device: Device| {
        let [name, address] = story.machines[device as usize].clone()?;
        Some(format!("{name}, {address}"))
    };
    let wheel = story.wheel_radius_mm.map(|mm| format!("radius {mm:.4} mm, as the grinder reported for its last pass"));
    let radius = registration.and_then(|found| found["probe_radius_mm"].as_f64()).filter(|mm| *mm > 0.0);
    let off = story.radius_error_mm.map(|(cycle, mm)| {
        format!(
            "; the radius measured on the reference sphere in cycle {cycle} differs by {:.2} \u{b5}m from the recipe",
            1e3 * mm
        )
    });
    let probe = radius.map(|mm| format!("radius {mm:.5} mm{}", off.unwrap_or_default()));
    let rows = [
        ("Measuring machine", machine(Device::Cmm)),
        ("Grinder", machine(Device::Grinder)),
        ("Wheel", wheel),
        ("Probe", probe),
    ];
    let row = |(key, value): (&str, Option<String>)| {
        format!("<tr><th>{key}</th><td>{}</td></tr>\n", escaped(&value.unwrap_or_else(not_told)))
    };
    let rows: String = rows.into_iter().map(row).collect();
    format!("<h2>Machines, wheel and probe</h2>\n<table id=\"means\">\n{rows}</table>\n")
}

/// Reads the file `model.json` of the last cycle whose measurement was registered. `story` is the history of the run
/// from its record, and `folder` the run folder. Returns `None` if no measurement was registered, or if the file cannot
/// be read or is not JSON.
pub(super) fn last_model(story: &RunHistory, folder: &Path) -> Option<Value> {
    let registration = story.cycles.values().rev().find_map(|of| of.registration.as_ref())?;
    let bytes = fs::read(folder.join(registration).with_file_name(CycleFile::Model.name())).ok()?;
    serde_json::from_slice(&bytes).ok()
}

/// Reads the file `registration.json` of the last cycle whose measurement was registered. Returns the number of this
/// cycle and the content of the file. `story` is the history of the run from its record, and `folder` the run folder.
/// Returns `Ok(None)` if no measurement was registered.
///
/// # Errors
/// Fails if the file cannot be read or is not JSON.
pub(super) fn last_registration(story: &RunHistory, folder: &Path) -> Result<Option<(u32, Value)>, ReportError> {
    let last = story.cycles.iter().rev().find_map(|(cycle, of)| Some((*cycle, of.registration.as_ref()?)));
    let Some((cycle, name)) = last else { return Ok(None) };
    let path = folder.join(name);
    let bytes = fs::read(&path).map_err(|source| FormatError::Unreadable { path: path.clone(), source })?;
    let found = serde_json::from_slice(&bytes)
        .map_err(|source| FormatError::Unreadable { path, source: io::Error::from(source) })?;
    Ok(Some((cycle, found)))
}

/// Returns two HTML tables about the registration of a cycle: the quality of the fit with the uncertainty of the pose,
/// and the uncertainty budget. `found` is the content of `registration.json`, and `model` the content of `model.json`.
/// If `model` is `None` or contains no budget, the second table is omitted.
pub(super) fn registered(cycle: u32, found: &Value, model: Option<&Value>) -> String {
    let number = |key: &str| found[key].as_f64();
    let count = |key: &str| found[key].as_array().map_or(0, Vec::len);
    let um = |mm: f64| format!("{:.2} \u{b5}m", 1e3 * mm);
    // A locked direction has no uncertainty in one file, and 0 in the other.
    let place = |stated: &Value| {
        let sigma = |key: &str| stated[key].as_f64().filter(|sigma| *sigma > 0.0);
        let shift = ["x_mm", "y_mm", "z_mm"].map(|key| sigma(key).map_or("locked".to_owned(), um)).join(", ");
        let turn = ["rx_rad", "ry_rad", "rz_rad"]
            .map(|key| sigma(key).map_or("locked".to_owned(), |rad| format!("{:.2} \u{b5}rad", 1e6 * rad)));
        format!("shift {shift} along x, y, z; rotation {} about x, y, z", turn.join(", "))
    };
    let frame = model.map_or("not on record".to_owned(), |model| place(&model["frame_standard_uncertainty"]));
    let converged = if found["converged"] == true { "converged" } else { "not converged" };
    let points = |key: &str| number(key).map_or("-".to_owned(), |n| format!("{n:.0}"));
    let verdict = format!(
        "{converged} in {} steps; {} of {} points used, {} outliers, {} points off the part; {:.1} % of the surface covered; RMS {}",
        points("iterations"),
        points("used"),
        points("points"),
        count("outliers"),
        count("off_part"),
        100.0 * number("coverage").unwrap_or(f64::NAN),
        number("rms_mm").map_or("-".to_owned(), um)
    );
    let words = |key: &str, of: fn(&Value) -> Option<&str>| -> Vec<String> {
        found[key].as_array().into_iter().flatten().filter_map(of).map(str::to_owned).collect()
    };
    let mut remarks = words("weak_directions", |weak| weak["words"].as_str());
    remarks.extend(words("warnings", Value::as_str));
    if count("alternatives") > 0 {
        remarks.push(format!("{} other poses of the part fit the points about equally well", count("alternatives")));
    }
    let remarks = if remarks.is_empty() { "none".to_owned() } else { remarks.join("; ") };
    let mut html = format!("<h2>Registration, cycle {cycle}</h2>\n<table id=\"registration\">\n");
    for (key, value) in [
        ("Fit", verdict),
        ("Repeatability of the pose (standard uncertainty)", place(&found["standard_uncertainty"])),
        ("Standard uncertainty of the nominal coordinate frame, including the uncertainty of the form", frame),
        ("Remarks", remarks),
    ] {
        let _ = writeln!(html, "<tr><th>{key}</th><td>{}</td></tr>", escaped(&value));
    }
    html + "</table>\n" + &model.map_or(String::new(), budget)
}

/// Returns the HTML table of the uncertainty budget of RMS and PV 99.8 %, with a row for each source of uncertainty.
/// Returns an empty text if `model`, the content of `model.json`, contains no budget.
fn budget(model: &Value) -> String {
    let Some(shares) = model["budget"].as_array().filter(|shares| !shares.is_empty()) else { return String::new() };
    let um = |share: &Value, key: &str| match (share["is_stated"] == true, share[key].as_f64()) {
        (true, Some(mm)) => format!("{:.3}", 1e3 * mm),
        _ => "not stated".to_owned(),
    };
    let rows = shares.iter().map(|share| {
        let source = source_words(share["source"].as_str().unwrap_or_default());
        let [rms, pv] = ["rms_mm", "pv_99_8_mm"].map(|key| um(share, key));
        format!("<tr><td>{}</td><td class=\"n\">{rms}</td><td class=\"n\">{pv}</td></tr>\n", escaped(source))
    });
    let whole = |key: &str| {
        let squares = shares.iter().filter_map(|share| share[key].as_f64()).map(|mm| mm * mm);
        format!("{:.3}", 1e3 * squares.sum::<f64>().sqrt())
    };
    format!(
        "<h2>Uncertainty budget</h2>\n<table id=\"budget\">\n<tr><th>source of standard uncertainty</th>\
         <th class=\"n\">of the RMS, \u{b5}m</th><th class=\"n\">of the PV 99.8 %, \u{b5}m</th></tr>\n{}\
         <tr><th>combined</th><td class=\"n\">{}</td><td class=\"n\">{}</td></tr>\n</table>\n\
         <p>The squares add up. A source that neither the cell file nor the recipe states counts as 0.</p>\n",
        rows.collect::<String>(),
        whole("rms_mm"),
        whole("pv_99_8_mm")
    )
}

/// Returns the description, for people, of a source of uncertainty. `name` is the name of the source in `model.json`;
/// an unknown name is returned unchanged.
fn source_words(name: &str) -> &str {
    match name {
        "scatter" => "noise of the probe",
        "form" => "form between the measured points",
        "pose" => "pose of the part",
        "radius" => "radius of the probe and of the reference sphere",
        "scales" => "scales of the machine",
        "squareness" => "squareness of the machine",
        "probe" => "error of the probe that depends on the direction",
        "temperature" => "temperature and expansion",
        "datum" => "position of the part in the fixture",
        other => other,
    }
}
