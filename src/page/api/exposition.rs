//! Text format of metrics: that of Prometheus (version 0.0.4), and OpenMetrics 1.0.
//!
//! The crate `prometheus-client` writes only OpenMetrics, from metrics that a program counts itself. Here each scrape reads
//! the figures anew, so the text is made from them directly.

use std::fmt::Write;

/// Media type of the format of Prometheus.
pub(super) const PROMETHEUS: &str = "text/plain; version=0.0.4; charset=utf-8";
/// Media type of OpenMetrics.
pub(super) const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Kind of a metric.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum MetricKind {
    Gauge,
    /// Number that only grows. Its name in the text ends with `_total`.
    Counter,
    /// Number and sum of observations.
    Summary,
}

/// Metric with its samples.
pub(super) struct Metric {
    /// Name without the ending `_total` of a counter. It ends with the base unit, if there is one.
    name: &'static str,
    kind: MetricKind,
    help: &'static str,
    samples: Vec<Sample>,
}

struct Sample {
    ending: &'static str,
    labels: Vec<(&'static str, String)>,
    value: f64,
}

/// Metrics of a scrape.
#[derive(Default)]
pub(super) struct Metrics(Vec<Metric>);

impl Metrics {
    /// Adds a metric without samples, and returns it. A metric without samples is not written.
    fn add(&mut self, name: &'static str, kind: MetricKind, help: &'static str) -> &mut Metric {
        self.0.push(Metric { name, kind, help, samples: Vec::new() });
        let last = self.0.len() - 1;
        &mut self.0[last]
    }

    /// Adds a gauge with its value; without a sample if the value is not known.
    pub(super) fn gauge(&mut self, name: &'static str, help: &'static str, value: Option<f64>) {
        self.gauges(name, help, value.map(|value| (Vec::new(), value)));
    }

    /// Adds a gauge with a value for each set of labels.
    pub(super) fn gauges(
        &mut self,
        name: &'static str,
        help: &'static str,
        values: impl IntoIterator<Item = (Vec<(&'static str, String)>, f64)>,
    ) {
        let metric = self.add(name, MetricKind::Gauge, help);
        values.into_iter().for_each(|(labels, value)| metric.push("", labels, value));
    }

    /// Adds a counter with a value for each set of labels.
    pub(super) fn counters(
        &mut self,
        name: &'static str,
        help: &'static str,
        values: impl IntoIterator<Item = (Vec<(&'static str, String)>, f64)>,
    ) {
        let metric = self.add(name, MetricKind::Counter, help);
        values.into_iter().for_each(|(labels, value)| metric.push("_total", labels, value));
    }

    /// Adds a summary of `durations`: their number and their sum.
    pub(super) fn summary(&mut self, name: &'static str, help: &'static str, durations: &[f64]) {
        let metric = self.add(name, MetricKind::Summary, help);
        metric.push("_sum", Vec::new(), durations.iter().sum());
        metric.push("_count", Vec::new(), durations.len() as f64);
    }

    /// Returns the text of the metrics in the format of Prometheus, or in that of OpenMetrics.
    pub(super) fn text(&self, is_open_metrics: bool) -> String {
        let mut text = String::new();
        for metric in self.0.iter().filter(|metric| !metric.samples.is_empty()) {
            metric.write(&mut text, is_open_metrics);
        }
        if is_open_metrics {
            text.push_str("# EOF\n");
        }
        text
    }
}

impl Metric {
    /// Adds a sample, if its value is finite.
    fn push(&mut self, ending: &'static str, labels: Vec<(&'static str, String)>, value: f64) {
        if value.is_finite() {
            self.samples.push(Sample { ending, labels, value });
        }
    }

    fn write(&self, text: &mut String, is_open_metrics: bool) {
        let Self { name, kind, help, samples } = self;
        let kind_name = match kind {
            MetricKind::Gauge => "gauge",
            MetricKind::Counter => "counter",
            MetricKind::Summary => "summary",
        };
        // In the format of Prometheus, the ending belongs to the name of a counter.
        let family = match (kind, is_open_metrics) {
            (MetricKind::Counter, false) => format!("{name}_total"),
            _ => (*name).to_owned(),
        };
        // Writing into a string does not fail.
        let _ = writeln!(text, "# HELP {family} {}", escaped(help, false));
        let _ = writeln!(text, "# TYPE {family} {kind_name}");
        for Sample { ending, labels, value } in samples {
            let labels: Vec<String> =
                labels.iter().map(|(label, value)| format!("{label}=\"{}\"", escaped(value, true))).collect();
            let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
            let _ = writeln!(text, "{name}{ending}{labels} {value}");
        }
    }
}

/// Returns `text` with the characters escaped that end a line or, in a label, its value.
fn escaped(text: &str, is_label: bool) -> String {
    let text = text.replace('\\', "\\\\").replace('\n', "\\n");
    if is_label { text.replace('"', "\\\"") } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics() -> Metrics {
        let mut metrics = Metrics::default();
        metrics.gauge("a_meters", "Length \\ of\nb", Some(4.5e-7));
        metrics.gauge("unknown", "Never written", None);
        metrics.gauge("nan", "Never written", Some(f64::NAN));
        metrics.counters("parts", "Parts", [(vec![("result", "a \"b\" \\\n".to_owned())], 3.0)]);
        metrics.summary("pass_seconds", "Passes", &[1.0, 2.5]);
        metrics
    }

    #[test]
    fn text_of_prometheus() {
        let expected = "# HELP a_meters Length \\\\ of\\nb\n# TYPE a_meters gauge\na_meters 0.00000045\n\
            # HELP parts_total Parts\n# TYPE parts_total counter\nparts_total{result=\"a \\\"b\\\" \\\\\\n\"} 3\n\
            # HELP pass_seconds Passes\n# TYPE pass_seconds summary\npass_seconds_sum 3.5\npass_seconds_count 2\n";
        assert_eq!(metrics().text(false), expected);
    }

    #[test]
    fn text_of_open_metrics() {
        let text = metrics().text(true);
        assert!(text.contains("# TYPE parts counter\nparts_total{") && text.ends_with("# EOF\n"), "{text}");
    }
}
