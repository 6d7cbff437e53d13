//! Table of the possible range of each value that a machine reports of itself, of a measurement or of a pass. A value
//! outside its range is refused, on every wire and for every use.

use std::sync::Arc;

use super::{DeviceError, Measurement, PassRecord, SignalValue, TouchStatus};

/// Possible range of a value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ValueRange {
    /// Name of the value, as in messages and docs/modbus.md.
    pub name: &'static str,
    /// Minimum possible value.
    pub min: f64,
    /// Maximum possible value.
    pub max: f64,
    /// Unit of the value.
    pub unit: &'static str,
}

const fn range(figure: &'static str, least: f64, most: f64, unit: &'static str) -> ValueRange {
    ValueRange { name: figure, min: least, max: most, unit }
}

const TEMPERATURE: ValueRange = range("the temperature", -40.0, 120.0, "degrees Celsius");
const DURATION: ValueRange = range("the duration", 0.0, 1e6, "s");
const PROBE_RADIUS: ValueRange = range("the probe's radius", 0.01, 50.0, "mm");
const COORDINATE: ValueRange = range("a coordinate", -1e5, 1e5, "mm");
const QUALITY: ValueRange = range("the quality of a point", 0.0, 100.0, "");
const COUNT: ValueRange = range("the scale of counts", 1e-9, 0.1, "mm");
const SPINDLE_LOAD: ValueRange = range("the spindle load", 0.0, 10.0, "");
const IDLE_SHARE: ValueRange = range("the share of the path without removal", 0.0, 1.0, "");

/// All ranges that apply to every machine. The ranges of a pass that depend on the command are in
/// `drive/pass_record.rs`.
pub const RANGES: [ValueRange; 8] =
    [TEMPERATURE, DURATION, PROBE_RADIUS, COORDINATE, QUALITY, COUNT, SPINDLE_LOAD, IDLE_SHARE];

impl ValueRange {
    fn contains(&self, value: f64) -> bool {
        (self.min..=self.max).contains(&value)
    }

    /// Returns a text that states why a value is outside the range. Returns `None` if the value is inside, or if it was
    /// not reported.
    fn violation(&self, value: Option<f64>) -> Option<String> {
        let value = value.filter(|value| !self.contains(*value))?;
        let Self { name: figure, min: least, max: most, unit } = self;
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        Some(format!("{figure} is {value}{unit}, limits {least} to {most}{unit}"))
    }

    fn refuse(&self, machine: &Arc<str>, value: f64) -> Result<(), DeviceError> {
        if self.contains(value) {
            return Ok(());
        }
        let (field, unit) = (self.name.to_owned(), self.unit.to_owned());
        let Self { min: least, max: most, .. } = *self;
        Err(DeviceError::OutOfRange { machine: Arc::clone(machine), field, value, min: least, max: most, unit })
    }
}

/// Checks two values of a status: the temperature in °C, and the progress as `(done, total)`. Returns the temperature
/// and the progress, each as `None` if it is missing or outside its possible range. Also returns a [`SignalValue`] for
/// each value outside its range, so that the value is reported.
///
/// An impossible value is not an error of the whole status, because the status also contains the state of the machine.
pub(super) fn plausible_status(
    temperature_c: Option<f64>,
    progress: (u32, u32),
) -> (Option<f64>, Option<(u32, u32)>, Vec<SignalValue>) {
    let (done, total) = progress;
    let of_progress = range("its progress", 0.0, f64::from(total), "of its job");
    let signal = |of: ValueRange, value: f64| {
        let ValueRange { name: figure, min: least, max: most, unit } = of;
        let (name, unit) = (figure.to_owned(), unit.to_owned());
        SignalValue { name, value: Some(value), unit, range: [least, most], cause: None }
    };
    let temperature = temperature_c.filter(|told| !TEMPERATURE.contains(*told)).map(|told| signal(TEMPERATURE, told));
    let steps = Some(f64::from(done)).filter(|done| !of_progress.contains(*done)).map(|done| signal(of_progress, done));
    let told = (temperature_c.filter(|_| temperature.is_none()), Some(progress).filter(|_| steps.is_none()));
    (told.0, told.1, temperature.into_iter().chain(steps).collect())
}

/// Checks that `scale_mm` is in the range that is physically possible. `scale_mm` is the length in mm of one count, the
/// unit in which a machine sends coordinates. `machine` is the name of the machine for the error message.
///
/// # Errors
/// `scale_mm` is outside the range.
pub(super) fn check_count_scale(machine: &Arc<str>, scale_mm: f64) -> Result<(), DeviceError> {
    COUNT.refuse(machine, scale_mm)
}

impl Measurement {
    /// Returns a text about the first value of the measurement that is physically impossible, with the allowed range,
    /// or `None`. Values that were not reported are not checked.
    pub fn range_violation(&self) -> Option<String> {
        let of_whole = TEMPERATURE
            .violation(self.temperature_c)
            .or_else(|| DURATION.violation(self.duration_s))
            .or_else(|| PROBE_RADIUS.violation(self.probe_radius_mm));
        of_whole.or_else(|| {
            let mut touched = self.points.iter().filter(|point| point.status == TouchStatus::Touched);
            touched.find_map(|point| {
                let of_place = point.position_mm.into_iter().find_map(|at_mm| COORDINATE.violation(Some(at_mm)));
                let flaw = of_place.or_else(|| QUALITY.violation(Some(f64::from(point.quality))))?;
                Some(format!("target {}: {flaw}", point.index))
            })
        })
    }
}

impl PassRecord {
    /// Returns a text about the first value of the pass record that is physically impossible, with the allowed range,
    /// or `None`. Values that were not reported are not checked.
    pub fn range_violation(&self) -> Option<String> {
        TEMPERATURE
            .violation(self.temperature_c)
            .or_else(|| DURATION.violation(self.duration_s))
            .or_else(|| SPINDLE_LOAD.violation(self.spindle_load))
            .or_else(|| IDLE_SHARE.violation(self.idle_share))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Coordinates, MeasuredPoint};

    fn measurement() -> Measurement {
        let point = MeasuredPoint { index: 7, status: TouchStatus::Touched, quality: 0, position_mm: [1.0, 2.0, 3.0] };
        let missed = MeasuredPoint { index: 8, status: TouchStatus::NotFound, quality: 0, position_mm: [f64::NAN; 3] };
        Measurement {
            points: vec![point, missed],
            coordinates: Coordinates::Centres,
            probe_radius_mm: Some(2.0),
            temperature_c: Some(20.0),
            duration_s: Some(60.0),
            plan_identity: [0; 32],
            job: 1,
            cycle: 1,
            done: 1,
        }
    }

    #[test]
    fn measurement_range_violation_is_named() {
        assert_eq!(measurement().range_violation(), None);
        let untold = Measurement { temperature_c: None, duration_s: None, probe_radius_mm: None, ..measurement() };
        assert_eq!(untold.range_violation(), None);
        let point = |quality, at_mm| {
            let mut of = measurement();
            (of.points[0].quality, of.points[0].position_mm) = (quality, at_mm);
            of
        };
        let cases = [
            (Measurement { temperature_c: Some(-327.0), ..measurement() }, "the temperature is -327 "),
            (Measurement { temperature_c: Some(f64::NAN), ..measurement() }, "the temperature is NaN "),
            (Measurement { duration_s: Some(-5.0), ..measurement() }, "the duration is -5 s"),
            (
                Measurement { probe_radius_mm: Some(0.0), ..measurement() },
                "the probe's radius is 0 mm, limits 0.01 to 50 mm",
            ),
            (point(101, [1.0; 3]), "target 7: the quality of a point is 101, limits 0 to 100"),
            (point(0, [1.0, 1e30, 1.0]), "target 7: a coordinate is 1000000000000000"),
            (point(0, [1.0, 1.0, f64::NEG_INFINITY]), "target 7: a coordinate is -inf mm"),
        ];
        for (measurement, words) in cases {
            let flaw =
                measurement.range_violation().unwrap_or_else(|| panic!("nothing is found wrong, expected {words}"));
            assert!(flaw.contains(words), "{flaw:?} without {words:?}");
        }
    }

    #[test]
    fn plausible_status_drops_bad_value() {
        let machine: Arc<str> = "a machine".into();
        for (temperature_c, progress) in [(Some(20.0), (0, 0)), (None, (7, 7)), (Some(-40.0), (0, 1000))] {
            assert_eq!(plausible_status(temperature_c, progress), (temperature_c, Some(progress), Vec::new()));
        }
        let flaws = |temperature_c, progress| {
            let (kept_c, kept, signals) = plausible_status(temperature_c, progress);
            (kept_c, kept, signals.iter().filter_map(SignalValue::problem).collect::<Vec<_>>().join("; "))
        };
        let (kept_c, kept, flaw) = flaws(Some(327.67), (3, 7));
        assert_eq!((kept_c, kept), (None, Some((3, 7))));
        assert_eq!(flaw, "the temperature is 327.67 degrees Celsius, limits -40 to 120 degrees Celsius");
        let (kept_c, kept, flaw) = flaws(Some(20.0), (549, 1));
        assert_eq!((kept_c, kept), (Some(20.0), None));
        assert_eq!(flaw, "its progress is 549 of its job, limits 0 to 1 of its job");
        assert_eq!(flaws(Some(f64::NAN), (1, 0)).2.matches(", limits").count(), 2);
        assert!(
            check_count_scale(&machine, 1e-6).is_ok()
                && check_count_scale(&machine, 0.0).is_err()
                && check_count_scale(&machine, f64::NAN).is_err()
        );
    }
}
