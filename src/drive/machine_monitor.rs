//! Last status of a machine and the course of its values, for display.
//!
//! The station adds each status that it reads. The drive reads the result when a person asks for it. No order and no
//! verdict uses it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use regrind_control::{MachineStatus, MachineValue, ValueKind};
use tokio::time::Instant;

use crate::cell::Device;
use crate::device::Status;

/// Maximum number of samples of a value. When there are more, each two neighbours become one.
const MAX_SAMPLES: usize = 240;
/// Duration of a sample at the beginning.
const FIRST_SAMPLE: Duration = Duration::from_secs(1);

/// Course of a value: its minimum and maximum over intervals of equal duration, which grow with the time of the run.
struct Trend {
    began_at: Instant,
    sample_duration: Duration,
    /// Minimum and maximum of each interval; `None` if there was no value in it.
    samples: Vec<Option<[f64; 2]>>,
}

impl Trend {
    fn new(now: Instant) -> Self {
        Self { began_at: now, sample_duration: FIRST_SAMPLE, samples: Vec::new() }
    }

    fn add(&mut self, now: Instant, value: f64) {
        if !value.is_finite() {
            return;
        }
        while self.index_at(now) >= MAX_SAMPLES {
            let joined = |pair: &[Option<[f64; 2]>]| pair.iter().flatten().copied().reduce(hull);
            self.samples = self.samples.chunks(2).map(joined).collect();
            self.sample_duration *= 2;
        }
        let at = self.index_at(now);
        self.samples.resize(self.samples.len().max(at + 1), None);
        self.samples[at] = Some(self.samples[at].map_or([value; 2], |known| hull(known, [value; 2])));
    }

    /// Returns the index of the sample at `now`, from 0. It can exceed the number of samples.
    fn index_at(&self, now: Instant) -> usize {
        let ratio = (now - self.began_at).as_secs_f64() / self.sample_duration.as_secs_f64();
        ratio as usize
    }

    /// Returns the samples as in [`MachineValue::samples`].
    fn aged(&self, now: Instant) -> Vec<[f64; 3]> {
        let duration_s = self.sample_duration.as_secs_f64();
        let age_s = |at: usize| (now - self.began_at).as_secs_f64() - at as f64 * duration_s;
        let known = self.samples.iter().enumerate();
        known.filter_map(|(at, sample)| sample.map(|[low, high]| [age_s(at), low, high])).collect()
    }
}

fn hull([a_low, a_high]: [f64; 2], [b_low, b_high]: [f64; 2]) -> [f64; 2] {
    [a_low.min(b_low), a_high.max(b_high)]
}

/// Last status of a machine with the courses of its values.
struct Observed {
    /// Status without the courses of its values.
    status: MachineStatus,
    answered_at: Option<Instant>,
    /// Courses of `status.values`, in the same order.
    trends: Vec<Trend>,
}

impl Observed {
    /// Removes the signals that are not among `names`: some are reported only while they are impossible.
    fn forget_other_signals(&mut self, names: &[&str]) {
        let is_kept = |value: &MachineValue| value.kind != ValueKind::Signal || names.contains(&value.name.as_str());
        let kept: Vec<bool> = self.status.values.iter().map(is_kept).collect();
        let mut keeps = kept.iter();
        self.status.values.retain(|_| keeps.next() == Some(&true));
        let mut keeps = kept.iter();
        self.trends.retain(|_| keeps.next() == Some(&true));
    }

    fn add(&mut self, kind: ValueKind, (name, unit): (&str, &str), range: Option<[f64; 2]>, value: Option<f64>) {
        let now = Instant::now();
        let values = &mut self.status.values;
        let at = values.iter().position(|known| known.kind == kind && known.name == name).unwrap_or_else(|| {
            let (name, unit) = (name.to_owned(), unit.to_owned());
            values.push(MachineValue { kind, name, unit, range, value, samples: Vec::new() });
            self.trends.push(Trend::new(now));
            values.len() - 1
        });
        (values[at].value, values[at].range) = (value, range);
        value.into_iter().for_each(|value| self.trends[at].add(now, value));
    }
}

/// Monitor of a machine, shared by its station and the drive.
#[derive(Clone)]
pub(super) struct MachineMonitor(Arc<Mutex<Observed>>);

impl MachineMonitor {
    pub(super) fn new(device: Device) -> Self {
        let status = MachineStatus {
            device,
            name: String::new(),
            state: None,
            is_connected: false,
            lost_links: 0,
            answer_age_s: None,
            is_automatic: None,
            is_clear: None,
            has_supplies: None,
            values: Vec::new(),
        };
        Self(Arc::new(Mutex::new(Observed { status, answered_at: None, trends: Vec::new() })))
    }

    fn observed(&self) -> MutexGuard<'_, Observed> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a status of the machine `name`, which answered within `answer_time`.
    pub(super) fn add_status(&self, name: &str, status: &Status, answer_time: Duration) {
        let mut observed = self.observed();
        observed.answered_at = Some(Instant::now());
        let shown = &mut observed.status;
        if shown.name != name {
            name.clone_into(&mut shown.name);
        }
        (shown.state, shown.is_connected) = (Some(status.state.to_string()), true);
        (shown.is_automatic, shown.is_clear, shown.has_supplies) =
            (status.automatic, status.clear_of_part, status.supplies);
        // A value that this status does not have is unknown now. A signal that it does not have is no longer shown.
        let names: Vec<&str> = status.signals.iter().map(|signal| signal.name.as_str()).collect();
        observed.forget_other_signals(&names);
        observed.add(ValueKind::AnswerTime, ("", "ms"), None, Some(1e3 * answer_time.as_secs_f64()));
        let is_known = observed.status.values.iter().any(|value| value.kind == ValueKind::Temperature);
        if status.temperature_c.is_some() || is_known {
            observed.add(ValueKind::Temperature, ("", "\u{b0}C"), None, status.temperature_c);
        }
        for signal in &status.signals {
            observed.add(ValueKind::Signal, (&signal.name, &signal.unit), Some(signal.range), signal.value);
        }
    }

    /// Notes that the link to the machine is lost.
    pub(super) fn add_lost_link(&self) {
        let shown = &mut self.observed().status;
        shown.is_connected = false;
        shown.lost_links += 1;
    }

    /// Returns the status of the machine with the courses of its values.
    pub(super) fn status(&self) -> MachineStatus {
        let (observed, now) = (self.observed(), Instant::now());
        let mut status = observed.status.clone();
        status.answer_age_s = observed.answered_at.map(|at| (now - at).as_secs_f64());
        for (value, trend) in status.values.iter_mut().zip(&observed.trends) {
            value.samples = trend.aged(now);
        }
        status
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{MachineState, SignalValue};

    #[tokio::test(start_paused = true)]
    async fn trend_keeps_extremes_of_any_duration() {
        let mut trend = Trend::new(Instant::now());
        assert_eq!(trend.aged(Instant::now()), [[0.0; 3]; 0]);
        // One value each 0.25 s for an hour, with two short peaks.
        for k in 0..14_400 {
            let value = match k {
                100 => -7.0,
                9_999 => 9.0,
                _ => 1.0 + f64::from(k % 2),
            };
            trend.add(Instant::now(), value);
            tokio::time::advance(Duration::from_millis(250)).await;
        }
        trend.add(Instant::now(), f64::NAN);
        let samples = trend.aged(Instant::now());
        assert!((120..=MAX_SAMPLES).contains(&samples.len()), "{}", samples.len());
        assert_eq!(samples[0][0], 3600.0);
        assert!(samples.windows(2).all(|pair| (pair[0][0] - pair[1][0] - 16.0).abs() < 1e-9), "{samples:?}");
        let extremes = samples.iter().map(|s| [s[1], s[2]]).reduce(hull);
        assert_eq!(extremes, Some([-7.0, 9.0]));
        // The peak at 2,499.75 s lies in the sample that begins 3,600 - 2,496 s ago.
        assert_eq!(samples.iter().find(|s| s[2] == 9.0).map(|s| s[0]), Some(1104.0));
        assert_eq!(samples[10][1..], [1.0, 2.0]);
    }

    #[tokio::test(start_paused = true)]
    async fn monitor_shows_last_status_and_lost_link() {
        let monitor = MachineMonitor::new(Device::Cmm);
        assert_eq!(monitor.status().answer_age_s, None);
        let load =
            |value| SignalValue { name: "load".into(), value, unit: "%".into(), range: [0.0, 90.0], cause: None };
        let status = |value| Status {
            temperature_c: Some(20.5),
            clear_of_part: Some(true),
            signals: vec![load(value)],
            ..Status::from_state(MachineState::Execute)
        };
        monitor.add_status("cmm at a", &status(Some(30.0)), Duration::from_millis(4));
        tokio::time::advance(Duration::from_secs(3)).await;
        monitor.add_status("cmm at a", &status(None), Duration::from_millis(2));
        monitor.add_lost_link();
        tokio::time::advance(Duration::from_secs(5)).await;
        let seen = monitor.status();
        assert_eq!((seen.state.as_deref(), seen.is_connected, seen.lost_links), (Some("EXECUTE"), false, 1));
        assert_eq!((seen.answer_age_s, seen.is_clear, seen.has_supplies), (Some(5.0), Some(true), None));
        let [answer, temperature, signal] = &seen.values[..] else { panic!("{seen:?}") };
        assert_eq!(answer.samples, [[8.0, 4.0, 4.0], [5.0, 2.0, 2.0]]);
        assert_eq!((temperature.value, temperature.kind), (Some(20.5), ValueKind::Temperature));
        // An impossible temperature is none: it is unknown, and no longer the last good one. A signal that is gone is not
        // shown.
        let later = Status { temperature_c: None, signals: Vec::new(), ..status(None) };
        monitor.add_status("cmm at a", &later, Duration::from_millis(1));
        let later = monitor.status();
        assert_eq!(later.values.iter().map(|value| value.value).collect::<Vec<_>>(), [Some(1.0), None]);
        // A missing value is unknown, and its course has no sample for it.
        assert_eq!(
            (signal.value, signal.range, &signal.samples[..]),
            (None, Some([0.0, 90.0]), &[[8.0, 30.0, 30.0]][..])
        );
    }
}
