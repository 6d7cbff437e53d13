//! Equipment that made and measured a part, and quality of its registration.

use std::fmt::Write;
use std::fs;
use std::io;
use std::path::Path;

use serde_json::Value;

use super::ReportError;
use super::report_content::Report;
use super::run_history::RunHistory;
use super::texts::ReportText as Text;
use regrind_cell::Device;
use regrind_formats::run_files::CycleFile;
use regrind_formats::{FormatError, escaped};
use regrind_language::decimal;
use regrind_record::MeasuringStrategy;

/// Returns the HTML table of the machines, the wheel and the probe of a run. `registration` is the content of the newest
/// file `registration.json`, or `None` if there is no such file; `folder` is the run folder. A value that is not on record is shown as not reported.
pub(super) fn equipment(report: &Report, registration: Option<&Value>, folder: &Path) -> String {
    let story = report.story;
    let machine = |device: Device| {
        let [name, address] = story.machines[device as usize].clone()?;
        Some(format!("{name}, {address}"))
    };
    let number = |value: f64, digits: usize| decimal(value, digits, report.language);
    let radius = |mm: f64, digits: usize| format!("{} {} mm", report.say(Text::Radius), number(mm, digits));
    let wheel = story.wheel_radius_mm.map(|mm| format!("{}, {}", radius(mm, 4), report.say(Text::LastPass)));
    let probe_mm = registration.and_then(|found| found["probe_radius_mm"].as_f64()).filter(|mm| *mm > 0.0);
    let off = story
        .radius_error_mm
        .map(|(cycle, mm)| format!("; {} {cycle}: {} \u{b5}m", report.say(Text::SphereRadius), number(1e3 * mm, 2)));
    let probe = probe_mm.map(|mm| format!("{}{}", radius(mm, 5), off.unwrap_or_default()));
    let strategy = story.start.content.part().and_then(|part| part.measuring);
    let celsius = temperature_c(story, folder).map(|celsius| format!("{} \u{b0}C", number(celsius, 2)));
    let rows = [
        (Text::MeasuringMachine, machine(Device::Cmm)),
        (Text::Grinder, machine(Device::Grinder)),
        (Text::Wheel, wheel),
        (Text::Probe, probe),
        (Text::MeasuringStrategy, strategy.map(|of| strategy_in_words(report, &of))),
        (Text::PartTemperature, celsius),
    ];
    let row = |(key, value): (Text, Option<String>)| {
        let value = value.unwrap_or_else(|| report.say(Text::NotReported).to_owned());
        format!("<tr><th>{}</th><td>{}</td></tr>\n", report.say(key), escaped(&value))
    };
    let rows: String = rows.into_iter().map(row).collect();
    format!("<h2>{}</h2>\n<table id=\"means\">\n{rows}</table>\n", report.say(Text::Machines))
}

fn strategy_in_words(report: &Report, of: &MeasuringStrategy) -> String {
    let number = |value: f64, digits: usize| decimal(value, digits, report.language);
    let targets = report.say(if of.adaptive { Text::TargetsChosen } else { Text::TargetsAll });
    let sphere = match of.sphere_points {
        0 => String::new(),
        points => format!("; {points} {}", report.say(Text::SpherePoints)),
    };
    format!(
        "{} {targets}{sphere}; {} {} mm/s; {} {} mm",
        of.targets,
        report.say(Text::ProbingSpeed),
        number(of.speed_mm_s, 2),
        report.say(Text::ApproachDistance),
        number(of.approach_mm, 2)
    )
}

/// Returns the temperature of the part at the last measurement that has it on record, or else at the last pass.
fn temperature_c(story: &RunHistory, folder: &Path) -> Option<f64> {
    let measured = story.cycles.values().rev().find_map(|of| {
        let bytes = fs::read(folder.join(of.conditions.as_ref()?)).ok()?;
        serde_json::from_slice::<Value>(&bytes).ok()?["temperature_c"].as_f64()
    });
    measured.or_else(|| story.cycles.values().rev().find_map(|of| of.pass.as_ref()?.temperature_c))
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
pub(super) fn registered(report: &Report, cycle: u32, found: &Value, model: Option<&Value>) -> String {
    let number = |value: f64, digits: usize| decimal(value, digits, report.language);
    let count = |key: &str| found[key].as_array().map_or(0, Vec::len);
    let um = |mm: f64| format!("{} \u{b5}m", number(1e3 * mm, 2));
    // A locked direction has no uncertainty in one file, and 0 in the other.
    let place = |stated: &Value| {
        /// A smaller value is the rounding of a locked direction, in mm or rad.
        const LOCKED: f64 = 1e-12;
        let sigma = |key: &str| stated[key].as_f64().filter(|sigma| *sigma > LOCKED);
        let locked = || report.say(Text::Locked).to_owned();
        let shift = ["x_mm", "y_mm", "z_mm"].map(|key| sigma(key).map_or_else(locked, um)).join("; ");
        let turn = ["rx_rad", "ry_rad", "rz_rad"]
            .map(|key| sigma(key).map_or_else(locked, |rad| format!("{} \u{b5}rad", number(1e6 * rad, 2))));
        format!("{}: {shift}. {}: {}", report.say(Text::Shift), report.say(Text::Rotation), turn.join("; "))
    };
    let frame =
        model.map_or(report.say(Text::NotOnRecord).to_owned(), |model| place(&model["frame_standard_uncertainty"]));
    let converged = report.say(if found["converged"] == true { Text::Converged } else { Text::NotConverged });
    let points = |key: &str| found[key].as_f64().map_or("-".to_owned(), |n| format!("{n:.0}"));
    let fit = format!(
        "{converged}, {}: {}; {} / {} {}; {} {}; {} {}; {} % {}; RMS {}",
        report.say(Text::Iterations),
        points("iterations"),
        points("used"),
        points("points"),
        report.say(Text::PointsUsed),
        count("outliers"),
        report.say(Text::Outliers),
        count("off_part"),
        report.say(Text::PointsOffPart),
        found["coverage"].as_f64().map_or("-".to_owned(), |share| number(100.0 * share, 1)),
        report.say(Text::SurfaceCovered),
        found["rms_mm"].as_f64().map_or("-".to_owned(), um)
    );
    let words = |key: &str, of: fn(&Value) -> Option<&str>| -> Vec<String> {
        found[key].as_array().into_iter().flatten().filter_map(of).map(str::to_owned).collect()
    };
    let mut remarks = words("weak_directions", |weak| weak["words"].as_str());
    remarks.extend(words("warnings", Value::as_str));
    if count("alternatives") > 0 {
        remarks.push(format!("{} {}", count("alternatives"), report.say(Text::OtherPoses)));
    }
    let remarks = if remarks.is_empty() { report.say(Text::None).to_owned() } else { remarks.join("; ") };
    let [title, of_cycle] = [Text::Registration, Text::Cycle].map(|text| report.say(text));
    let mut html = format!("<h2>{title}, {of_cycle} {cycle}</h2>\n<table id=\"registration\">\n");
    for (key, value) in [
        (Text::Fit, fit),
        (Text::Repeatability, place(&found["standard_uncertainty"])),
        (Text::FrameUncertainty, frame),
        (Text::Remarks, remarks),
    ] {
        let _ = writeln!(html, "<tr><th>{}</th><td>{}</td></tr>", report.say(key), escaped(&value));
    }
    html + "</table>\n" + &model.map_or(String::new(), |model| budget(report, model))
}

/// Returns the HTML table of the uncertainty budget of RMS and PV 99.8 %, with a row for each source of uncertainty.
/// Returns an empty text if `model`, the content of `model.json`, contains no budget.
fn budget(report: &Report, model: &Value) -> String {
    let Some(shares) = model["budget"].as_array().filter(|shares| !shares.is_empty()) else { return String::new() };
    let number = |mm: f64| decimal(1e3 * mm, 3, report.language);
    let um = |share: &Value, key: &str| match (share["is_stated"] == true, share[key].as_f64()) {
        (true, Some(mm)) => number(mm),
        _ => report.say(Text::NotStated).to_owned(),
    };
    let rows = shares.iter().map(|share| {
        let name = share["source"].as_str().unwrap_or_default();
        let source = source(name).map_or(name, |text| report.say(text));
        let [rms, pv] = ["rms_mm", "pv_99_8_mm"].map(|key| um(share, key));
        format!("<tr><td>{}</td><td class=\"n\">{rms}</td><td class=\"n\">{pv}</td></tr>\n", escaped(source))
    });
    let whole = |key: &str| {
        let squares = shares.iter().filter_map(|share| share[key].as_f64()).map(|mm| mm * mm);
        number(squares.sum::<f64>().sqrt())
    };
    let [title, source, rms, pv, combined, sum] =
        [Text::Budget, Text::Source, Text::ShareOfRms, Text::ShareOfPv, Text::Combined, Text::SquaresAddUp]
            .map(|text| report.say(text));
    format!(
        "<h2>{title}</h2>\n<table id=\"budget\">\n<thead><tr><th>{source}</th>\
         <th class=\"n\">{rms}, \u{b5}m</th><th class=\"n\">{pv}, \u{b5}m</th></tr></thead>\n{}\
         <tr><th>{combined}</th><td class=\"n\">{}</td><td class=\"n\">{}</td></tr>\n</table>\n<p>{sum}</p>\n",
        rows.collect::<String>(),
        whole("rms_mm"),
        whole("pv_99_8_mm")
    )
}

/// Returns the text of a source of uncertainty. `name` is the name of the source in `model.json`.
fn source(name: &str) -> Option<Text> {
    Some(match name {
        "scatter" => Text::SourceScatter,
        "form" => Text::SourceForm,
        "pose" => Text::SourcePose,
        "radius" => Text::SourceRadius,
        "scales" => Text::SourceScales,
        "squareness" => Text::SourceSquareness,
        "probe" => Text::SourceProbe,
        "temperature" => Text::SourceTemperature,
        "datum" => Text::SourceDatum,
        _ => return None,
    })
}
