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
    /// Limits of PV and RMS in µm.
    limits_um: [Option<f64>; 2],
    cycles: Vec<ReportedCycle>,
}

struct ReportedCycle {
    cycle: i32,
    verdict: Option<String>,
    /// PV, its uncertainty, RMS and its uncertainty in µm.
    figures_um: [Option<f64>; 4],
}

impl Reported {
    /// Reads the report about the run with this `id` from the plant.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached, or refuses the query.
    pub async fn read(link: &DatabaseLink, id: i32) -> Result<Self, PlantError> {
        let failed = refused("the report of a cell");
        let text = "SELECT result, verdict, pv_limit_um, rms_limit_um FROM run WHERE id = $1";
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
            limits_um: [2, 3].map(|k| row.get(k)),
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
        let mut differences = Vec::new();
        let mut compare = |what: String, reported: &Value, recorded: &Value| {
            if !is_same(reported, recorded) {
                let said = |value: &Value| value.as_str().map_or_else(|| value.to_string(), ToOwned::to_owned);
                differences.push(format!(
                    "{what} is {} in the report and {} in the record",
                    said(reported),
                    said(recorded)
                ));
            }
        };
        let is_over = self.result.as_deref().is_some_and(|result| result != "open");
        if is_over {
            compare("the result".into(), &self.result.as_deref().into(), &overview["result"]);
            compare("the verdict".into(), &self.verdict.as_deref().into(), &overview["verdict"]);
            for (name, limit_um) in ["pv_limit_um", "rms_limit_um"].into_iter().zip(self.limits_um) {
                compare(name.into(), &limit_um.into(), &overview[name]);
            }
        }
        let recorded = overview["cycles"].as_array().map_or(&[][..], |cycles| cycles);
        if is_over && recorded.len() != self.cycles.len() {
            compare("the number of cycles".into(), &self.cycles.len().into(), &recorded.len().into());
        }
        for told in &self.cycles {
            let found = recorded.iter().find(|found| found["cycle"] == told.cycle).unwrap_or(&Value::Null);
            compare(format!("the verdict of cycle {}", told.cycle), &told.verdict.as_deref().into(), &found["verdict"]);
            for (name, figure_um) in ["pv_um", "pv_u_um", "rms_um", "rms_u_um"].into_iter().zip(told.figures_um) {
                compare(format!("{name} of cycle {}", told.cycle), &figure_um.into(), &found[name]);
            }
        }
        differences
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
        let cycle = |cycle, pv_um| ReportedCycle {
            cycle,
            verdict: Some("continue".into()),
            figures_um: [Some(pv_um), Some(0.4), Some(1.0), None],
        };
        Reported {
            result: Some(result.into()),
            verdict: Some("ACCEPTED".into()),
            limits_um: [Some(7.0), None],
            cycles: vec![cycle(1, 20.0), cycle(2, pv_um)],
        }
    }

    fn overview(result: &str) -> Value {
        let cycle = |cycle: i32, pv_um: f64| json!({ "cycle": cycle, "verdict": "continue", "pv_um": pv_um, "pv_u_um": 0.4, "rms_um": 1, "rms_u_um": null });
        json!({ "result": result, "verdict": "ACCEPTED", "pv_limit_um": 7.0, "rms_limit_um": null, "cycles": [cycle(1, 20.0), cycle(2, 4.0)] })
    }

    #[test]
    fn better_figures_than_those_of_record_are_found() {
        assert_eq!(reported("accepted", 4.0).differences(&overview("accepted")), Vec::<String>::new());
        let better = reported("accepted", 3.0).differences(&overview("not accepted"));
        assert_eq!(better.len(), 2, "{better:?}");
        assert!(better[0].contains("accepted in the report and not accepted in the record"), "{better:?}");
        assert!(better[1].contains("pv_um of cycle 2 is 3.0 in the report and 4.0 in the record"), "{better:?}");
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
