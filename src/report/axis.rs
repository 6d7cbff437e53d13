//! Positions and labels of the ticks of an axis.

/// Mapping of a coordinate to the position along an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scale {
    /// Linear.
    #[default]
    Linear,
    /// Logarithmic.
    Log,
}

/// Mapping of a range of coordinates to a range of pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ruler {
    scale: Scale,
    /// First and last coordinate, as logarithms to base 10 on a logarithmic axis.
    range: [f64; 2],
    pixels: [f64; 2],
}

/// Tick with its pixel and its label. An exponent is drawn raised, after the label.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tick {
    pub(super) pixel: f64,
    pub(super) label: String,
    pub(super) exponent: Option<i32>,
}

impl Ruler {
    /// Creates the mapping from coordinates to pixels: `range` (first and last coordinate) is mapped to `pixels` (first
    /// and last pixel). On a logarithmic axis the coordinates must be above 0.
    pub(super) fn new(scale: Scale, range: [f64; 2], pixels: [f64; 2]) -> Self {
        let range = match scale {
            Scale::Linear => range,
            Scale::Log => range.map(f64::log10),
        };
        Self { scale, range, pixels }
    }

    /// Returns the same mapping with a range that is extended, where necessary, so that it begins and ends at a tick.
    /// On a linear axis, `most` is the maximum number of intervals between ticks in the old range; the extended range
    /// can have one interval more. On a logarithmic axis, the new range begins and ends at a power of ten, and `most`
    /// is not used.
    pub(super) fn rounded(self, most: usize) -> Self {
        let [low, high] = self.range;
        let step = match self.scale {
            Scale::Linear => nice_step(high - low, most),
            Scale::Log => 1.0,
        };
        let mut range = [(low / step + 1e-9).floor() * step, (high / step - 1e-9).ceil() * step];
        if range[1] <= range[0] {
            range = [range[0] - step, range[0] + step];
        }
        Self { range, ..self }
    }

    /// Returns the first and the last coordinate.
    pub(super) fn range(&self) -> [f64; 2] {
        match self.scale {
            Scale::Linear => self.range,
            Scale::Log => self.range.map(|power| 10f64.powf(power)),
        }
    }

    /// Returns the position of a coordinate, in pixels.
    pub(super) fn pixel(&self, value: f64) -> f64 {
        let value = if self.scale == Scale::Log { value.log10() } else { value };
        let t = (value - self.range[0]) / (self.range[1] - self.range[0]);
        self.pixels[0] + t * (self.pixels[1] - self.pixels[0])
    }

    /// Returns the round numbers within the range of a linear axis, at most `most` steps, each with the decimals that the
    /// step needs. The decimals are `None` if the numbers need an exponent.
    pub(super) fn round_coordinates(&self, most: usize) -> Vec<(f64, Option<usize>)> {
        let [low, high] = self.range;
        let step = nice_step(high - low, most);
        let decimals = (1e-4..1e6).contains(&step).then(|| (-(step.log10() + 1e-9).floor()).max(0.0) as usize);
        round_numbers(low, high, step).map(|value| (value, decimals)).collect()
    }

    /// Returns the ticks at round numbers within the range of the axis. On a logarithmic axis these are powers of ten.
    /// `most` is the maximum number of intervals into which the ticks divide the range.
    pub(super) fn ticks(&self, most: usize) -> Vec<Tick> {
        let [low, high] = self.range;
        match self.scale {
            Scale::Linear => {
                let step = nice_step(high - low, most);
                round_numbers(low, high, step)
                    .map(|value| Tick { pixel: self.pixel(value), label: label(value, step), exponent: None })
                    .collect()
            }
            Scale::Log => {
                let step = nice_step(high - low, most).max(1.0).round();
                round_numbers(low, high, step)
                    .map(|power| Tick {
                        pixel: self.pixel(10f64.powf(power)),
                        label: "10".into(),
                        exponent: Some(power as i32),
                    })
                    .collect()
            }
        }
    }
}

/// Returns the smallest round number that is at least `limit`: 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 or 8 times a power of
/// ten. Neighbouring maps then often have the same scale. The page of a cell rounds in the same way.
pub(super) fn round_limit(limit: f64) -> f64 {
    if !(limit > 0.0 && limit.is_finite()) {
        return 1.0;
    }
    let decade = 10f64.powf(limit.log10().floor());
    let steps = [1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0];
    steps.map(|step| step * decade).into_iter().find(|round| *round >= 0.999 * limit).unwrap_or(limit)
}

/// Returns the smallest step of 1, 2 or 5 times a power of ten that divides `extent` into at most `most` steps.
fn nice_step(extent: f64, most: usize) -> f64 {
    let extent = if extent > 0.0 { extent } else { 1.0 };
    let least = extent / most.max(1) as f64;
    let power = 10f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|&s| s >= least * (1.0 - 1e-9)).unwrap_or(10.0 * power)
}

/// Returns the multiples of `step` from `low` to `high`, with a tolerance for rounding at both ends.
fn round_numbers(low: f64, high: f64, step: f64) -> impl Iterator<Item = f64> {
    let first = (low / step - 1e-6).ceil() as i64;
    let last = (high / step + 1e-6).floor() as i64;
    (first..=last).map(move |k| k as f64 * step)
}

/// Returns the label of the tick at `value`. `step` is the distance between ticks, and `value` is a multiple of `step`.
/// The label has as many decimals as `step` needs. If `step` is below 1e-4, or is 1e6 or more, the label has one digit
/// and an exponent, such as "2e−7". The label of 0 is always "0".
pub(super) fn label(value: f64, step: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    if !(1e-4..1e6).contains(&step) {
        return format!("{value:.0e}").replace('-', "\u{2212}");
    }
    let decimals = (-(step.log10() + 1e-9).floor()).max(0.0) as usize;
    format!("{value:.decimals$}").replace('-', "\u{2212}")
}

/// Formats a number with a number of decimals and a true minus sign.
pub(super) fn fixed(value: f64, decimals: usize) -> String {
    format!("{value:.decimals$}").replace('-', "\u{2212}")
}

/// Formats a number with three significant digits. A magnitude below 1e-4, or of 1e6 and more, gets an exponent.
pub(super) fn three_digits(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let power = value.abs().log10().floor();
    if !(-4.0..6.0).contains(&power) {
        return format!("{value:.2e}").replace('-', "\u{2212}");
    }
    let decimals = (2.0 - power).max(0.0) as usize;
    format!("{value:.decimals$}").replace('-', "\u{2212}")
}

/// Formats a count with a comma as the thousands separator, such as 1,234,567.
pub(super) fn grouped(count: usize) -> String {
    let digits = count.to_string();
    let mut out = String::with_capacity(digits.len() + digits.len() / 3);
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: Scale, range: [f64; 2], most: usize) -> Vec<String> {
        let written = |t: Tick| t.exponent.map_or(t.label, |e| format!("1e{e}"));
        Ruler::new(scale, range, [0.0, 100.0]).ticks(most).into_iter().map(written).collect()
    }

    #[test]
    fn ticks_at_round_numbers() {
        assert_eq!(labels(Scale::Linear, [-51.0, 51.0], 6), ["\u{2212}40", "\u{2212}20", "0", "20", "40"]);
        assert_eq!(labels(Scale::Linear, [0.0, 1.0], 5), ["0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        assert_eq!(labels(Scale::Linear, [0.0, 3e-7], 3), ["0", "1e\u{2212}7", "2e\u{2212}7", "3e\u{2212}7"]);
        assert_eq!(labels(Scale::Log, [1e-20, 1e5], 6), ["1e-20", "1e-15", "1e-10", "1e-5", "1e0", "1e5"]);
        assert_eq!(labels(Scale::Log, [0.5, 20.0], 6), ["1e0", "1e1"]);
    }

    #[test]
    fn tick_count_is_bounded() {
        for power in -9..9 {
            for mantissa in [1.0, 1.7, 3.3, 4.99, 7.2, 9.9] {
                let extent = mantissa * 10f64.powi(power);
                let count = labels(Scale::Linear, [-0.37 * extent, 0.63 * extent], 6).len();
                assert!((2..=7).contains(&count), "{extent}: {count}");
            }
        }
    }

    #[test]
    fn rounded_range_contains_range() {
        let ruler = Ruler::new(Scale::Log, [3e-3, 2e4], [0.0, 80.0]).rounded(8);
        assert_eq!(ruler.range, [-3.0, 5.0]);
        assert!((ruler.pixel(1.0) - 30.0).abs() < 1e-12);
        let flat = Ruler::new(Scale::Linear, [2.0, 2.0], [0.0, 1.0]).rounded(4);
        assert!(flat.range[0] < 2.0 && flat.range[1] > 2.0, "{:?}", flat.range);
    }

    #[test]
    fn limits_are_round() {
        assert_eq!([0.0, 4.2, 0.11, 20.0, 8.1, f64::NAN].map(round_limit), [1.0, 5.0, 0.12, 20.0, 10.0, 1.0]);
    }

    #[test]
    fn thousands_are_grouped() {
        assert_eq!(["0", "999", "1,000", "28,476", "1,265,640"], [0, 999, 1000, 28476, 1265640].map(grouped));
    }

    #[test]
    fn three_digits_formatting() {
        assert_eq!(["6.90", "27.3", "451", "0.00412", "0"], [6.9, 27.31, 451.4, 0.004123, 0.0].map(three_digits));
    }
}
