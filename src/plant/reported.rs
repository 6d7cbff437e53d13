//! Figures of a run as its cell reported them, compared with those of its record.
//!
//! Lists, yields and trends are made from the report, because a database cannot evaluate records. So a cell, or whoever
//! has its password, could report better figures than its record has.

use serde_json::Value;

use super::Row;
use super::error::{PlantError, refused};
use super::link::DatabaseLink;

/// Largest difference of two equal figures, as a share: they are written with all their digits.
const SAME: f64 = 1e-9;

/// Report of a cell about one of its runs.
pub struct Reported {
    result: Option<String>,
    verdict: Option<String>,
    grinder: Option<String>,
    cmm: Option<String>,
    wheel: Option<String>,
    alarms: Option<i32>,
    /// Limits of PV and RMS in µm.
    limits_um: [Option<f64>; 2],
    /// The figures that trends and lists show, as those of a cycle.
    last_um: [Option<f64>; 4],
    cycles: Vec<ReportedCycle>,
}

struct ReportedCycle {
    cycle: i32,
    verdict: Option<String>,
    /// PV, its uncertainty, RMS and its uncertainty in µm.
    figures_um: [Option<f64>; 4],
}

/// Names of the figures of a cycle: in the overview of a record, and for people.
const FIGURES: [(&str, &str); 4] =
    [("pv_um", "PV"), ("pv_u_um", "the uncertainty of PV"), ("rms_um", "RMS"), ("rms_u_um", "the uncertainty of RMS")];

/// Names of the limits of a part.
const LIMITS: [(&str, &str); 2] = [("pv_limit_um", "the limit of PV"), ("rms_limit_um", "the limit of RMS")];

impl Reported {
    /// Reads the report about the run with this `id` from the plant.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached, or refuses the query.
    pub async fn read(link: &DatabaseLink, id: i32) -> Result<Self, PlantError> {
        let failed = refused("the report of a cell");
        let text = "SELECT result, verdict, grinder, cmm, wheel, alarms, pv_limit_um, rms_limit_um, pv_um, pv_u_um, rms_um, rms_u_um
            FROM run WHERE id = $1";
        let row = link.client().query_one(text, &[&id]).await.map_err(&failed)?;
        let text = "SELECT cycle, verdict, pv_um, pv_u_um, rms_um, rms_u_um FROM cycle WHERE run = $1 ORDER BY cycle LIMIT 10000";
        let cycles = link.client().query(text, &[&id]).await.map_err(failed)?;
        let cycle = |row: &Row| ReportedCycle {
            cycle: row.get(0),
            verdict: row.get(1),
            figures_um: [2, 3, 4, 5].map(|k| row.get(k)),
        };
        Ok(Self {
            result: row.get(0),
            verdict: row.get(1),
            grinder: row.get(2),
            cmm: row.get(3),
            wheel: row.get(4),
            alarms: row.get(5),
            limits_um: [6, 7].map(|k| row.get(k)),
            last_um: [8, 9, 10, 11].map(|k| row.get(k)),
            cycles: cycles.iter().map(cycle).collect(),
        })
    }

    /// Compares the report with `overview`, the summary of the record as [`super::run_overview`] makes it. Returns each
    /// difference in words. The report of a run that is under way can lag behind its record, so only cycles and an end
    /// that it has are compared. An `overview` of `null` gives no differences.
    pub fn differences(&self, overview: &Value) -> Vec<String> {
        if overview.is_null() {
            return Vec::new();
        }
        let mut differences = Differences(Vec::new());
        let recorded = overview["cycles"].as_array().map_or(&[][..], |cycles| cycles);
        if self.result.as_deref().is_some_and(|result| result != "open") {
            let texts = [&self.result, &self.verdict, &self.grinder, &self.cmm, &self.wheel];
            for (name, told) in ["result", "verdict", "grinder", "cmm", "wheel"].into_iter().zip(texts) {
                differences.compare(format!("the {name}"), &told.as_deref().into(), &overview[name]);
            }
            differences.compare("the number of alarms".into(), &self.alarms.into(), &overview["alarms"]);
            differences.compare("the number of cycles".into(), &self.cycles.len().into(), &recorded.len().into());
            for ((name, words), limit_um) in LIMITS.into_iter().zip(self.limits_um) {
                differences.compare_um(words.into(), limit_um, &overview[name]);
            }
            let last = recorded.iter().rev().find(|cycle| !cycle["pv_um"].is_null()).unwrap_or(&Value::Null);
            for ((name, words), told_um) in FIGURES.into_iter().zip(self.last_um) {
                differences.compare_um(format!("{words} of the part"), told_um, &last[name]);
            }
        }
        for told in &self.cycles {
            let found = recorded.iter().find(|found| found["cycle"] == told.cycle).unwrap_or(&Value::Null);
            let what = format!("the verdict of cycle {}", told.cycle);
            differences.compare(what, &told.verdict.as_deref().into(), &found["verdict"]);
            for ((name, words), told_um) in FIGURES.into_iter().zip(told.figures_um) {
                differences.compare_um(format!("{words} of cycle {}", told.cycle), told_um, &found[name]);
            }
        }
        differences.0
    }
}

/// Differences of a report from the record, in words.
struct Differences(Vec<String>);

impl Differences {
    fn compare(&mut self, what: String, reported: &Value, recorded: &Value) {
        let said = |value: &Value| match value {
            Value::Null => "not stated".to_owned(),
            Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        self.compare_as(what, reported, recorded, said);
    }

    /// Compares two figures in µm.
    fn compare_um(&mut self, what: String, reported_um: Option<f64>, recorded: &Value) {
        let reported = Value::from(reported_um);
        let shown = |value: &Value| value.as_f64().map_or_else(|| "not stated".to_owned(), |um| format!("{um:.3} µm"));
        // A difference that three decimals do not show is shown with all digits.
        match shown(&reported) == shown(recorded) {
            true => self.compare(what, &reported, recorded),
            false => self.compare_as(what, &reported, recorded, shown),
        }
    }

    fn compare_as(&mut self, what: String, reported: &Value, recorded: &Value, shown: impl Fn(&Value) -> String) {
        if !is_same(reported, recorded) {
            self.0.push(format!("{what} is {} in the report and {} in the record", shown(reported), shown(recorded)));
        }
    }
}

fn is_same(a: &Value, b: &Value) -> bool {
    match (a.as_f64(), b.as_f64()) {
        (Some(a), Some(b)) => (a - b).abs() <= SAME * a.abs().max(b.abs()),
        _ => a == b,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn reported(result: &str, pv_um: f64) -> Reported {
        let figures_um = |pv_um| [Some(pv_um), Some(0.4), Some(1.0), None];
        let cycle =
            |cycle, pv_um| ReportedCycle { cycle, verdict: Some("continue".into()), figures_um: figures_um(pv_um) };
        Reported {
            result: Some(result.into()),
            verdict: Some("ACCEPTED".into()),
            grinder: Some("G".into()),
            cmm: None,
            wheel: Some("R 12.500 mm".into()),
            alarms: Some(2),
            limits_um: [Some(7.0), None],
            last_um: figures_um(pv_um),
            cycles: vec![cycle(1, 20.0), cycle(2, pv_um)],
        }
    }

    fn overview(result: &str) -> Value {
        let cycle = |cycle: i32, pv_um: f64| json!({ "cycle": cycle, "verdict": "continue", "pv_um": pv_um, "pv_u_um": 0.4, "rms_um": 1, "rms_u_um": null });
        json!({ "result": result, "verdict": "ACCEPTED", "grinder": "G", "cmm": null, "wheel": "R 12.500 mm", "alarms": 2,
            "pv_limit_um": 7.0, "rms_limit_um": null, "cycles": [cycle(1, 20.0), cycle(2, 4.0)] })
    }

    #[test]
    fn better_figures_than_those_of_record_are_found() {
        assert_eq!(reported("accepted", 4.0).differences(&overview("accepted")), Vec::<String>::new());
        let better = reported("accepted", 3.0).differences(&overview("not accepted"));
        assert_eq!(
            better,
            [
                "the result is accepted in the report and not accepted in the record",
                "PV of the part is 3.000 µm in the report and 4.000 µm in the record",
                "PV of cycle 2 is 3.000 µm in the report and 4.000 µm in the record",
            ]
        );
        // The figure of the part alone, which trends show; a small difference; figures that the record does not have.
        let mut part = reported("accepted", 4.0);
        part.last_um[0] = Some(4.000_01);
        let found = part.differences(&overview("accepted"));
        assert_eq!(found, ["PV of the part is 4.00001 in the report and 4.0 in the record"]);
        let mut more = reported("accepted", 4.0);
        (more.limits_um[1], more.alarms, more.cmm) = (Some(1.0), Some(0), Some("C".into()));
        let found = more.differences(&overview("accepted"));
        assert!(found.len() == 3 && found[2].contains("1.000 µm in the report and not stated"), "{found:?}");
    }

    #[test]
    fn report_may_lag_behind_record() {
        let mut lags = reported("open", 4.0);
        assert_eq!(lags.differences(&overview("accepted")), Vec::<String>::new());
        lags.cycles.pop();
        assert_eq!(lags.differences(&overview("accepted")), Vec::<String>::new());
        lags.result = Some("accepted".into());
        assert_eq!(lags.differences(&overview("accepted")).len(), 1, "a cycle is missing");
        assert_eq!(lags.differences(&Value::Null), Vec::<String>::new());
    }
}
