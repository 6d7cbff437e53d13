//! Colours that people with colour blindness can also distinguish.

/// Colour map: how a value becomes a colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ColourMap {
    /// Blue below zero, near white at zero, red above: ColorBrewer's RdBu with 11 classes, reversed and interpolated.
    ///
    /// Both arms darken equally and steadily, so that a grey print still shows the magnitude. Red and blue are
    /// distinguishable with every common colour blindness. For signed quantities; the range is symmetric about zero.
    #[default]
    Diverging,
    /// Dark violet to yellow, lightening steadily: nine colours of matplotlib's viridis, interpolated.
    ///
    /// For quantities without a sign.
    Sequential,
}

const DIVERGING: [u32; 11] = [
    0x05_3061, 0x21_66ac, 0x43_93c3, 0x92_c5de, 0xd1_e5f0, 0xf7_f7f7, 0xfd_dbc7, 0xf4_a582, 0xd6_604d, 0xb2_182b,
    0x67_001f,
];

const SEQUENTIAL: [u32; 9] =
    [0x44_0154, 0x47_2d7b, 0x3b_528b, 0x2c_728e, 0x21_918c, 0x28_ae80, 0x5e_c962, 0xad_dc30, 0xfd_e725];

impl ColourMap {
    /// Returns the colour (red, green and blue of sRGB) at a position in the colour map. `share` is 0 at the lower end
    /// and 1 at the upper end; a value outside this range gives the colour of the nearer end.
    pub fn at(self, share: f64) -> [u8; 3] {
        let anchors = self.anchors();
        let place = share.clamp(0.0, 1.0) * (anchors.len() - 1) as f64;
        let below = (place as usize).min(anchors.len() - 2);
        let (low, high) = (channels(anchors[below]), channels(anchors[below + 1]));
        let t = place - below as f64;
        std::array::from_fn(|k| (f64::from(low[k]) * (1.0 - t) + f64::from(high[k]) * t).round() as u8)
    }

    /// Returns the colours (0xRRGGBB) between which the map is interpolated linearly. They are equally spaced from the
    /// lower end to the upper.
    pub(super) fn anchors(self) -> &'static [u32] {
        match self {
            Self::Diverging => &DIVERGING,
            Self::Sequential => &SEQUENTIAL,
        }
    }

    /// Returns the identifier of the colour gradient in an SVG. Figures in one document that use the same colours share
    /// it.
    pub(super) fn id(self) -> &'static str {
        match self {
            Self::Diverging => "regrind-diverging",
            Self::Sequential => "regrind-sequential",
        }
    }
}

/// Mapping of values to colours: a range, and an optional band of values that are in tolerance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tones {
    pub(super) colours: ColourMap,
    /// Values at the two ends.
    pub(super) range: [f64; 2],
    /// Half the width of the band about zero.
    pub(super) tolerance: Option<f64>,
}

/// Share of an arm of the diverging map that values in tolerance use: only a tint. An arm is the half of the map on one
/// side of zero.
const TINT: f64 = 0.12;
/// Share of an arm at which values beyond the tolerance begin: a step that is visible in print and with colour
/// blindness.
const STEP: f64 = 0.4;
/// Minimum ratio of the limit of a colour bar to its tolerance band.
const BEYOND: f64 = 1.25;

impl Tones {
    /// Returns a diverging colour scale from `-limit` to `limit`. If `tolerance` is given, values from `-tolerance` to
    /// `tolerance` get only a tint (a very light colour). If `limit` is less than 1.25 times `tolerance`, uses 1.25
    /// times `tolerance` instead. If the limit is then not above 0, uses 1.
    pub(super) fn symmetric(limit: f64, tolerance: Option<f64>) -> Self {
        let limit = limit.max(tolerance.map_or(0.0, |t| BEYOND * t));
        // If all values are zero, they have no range of their own.
        let limit = if limit > 0.0 { limit } else { 1.0 };
        Self { colours: ColourMap::Diverging, range: [-limit, limit], tolerance }
    }

    /// Returns the colour (red, green, blue) of a value. Values beyond the range get the colour of the nearer end.
    pub(super) fn at(&self, value: f64) -> [u8; 3] {
        let [low, high] = self.range;
        let Some(band) = self.tolerance else { return self.colours.at((value - low) / (high - low)) };
        let size = value.abs();
        let arm = if size <= band {
            TINT * size / band
        } else {
            STEP + (1.0 - STEP) * ((size - band) / (high - band).max(f64::MIN_POSITIVE)).min(1.0)
        };
        self.colours.at(0.5 + 0.5 * arm.copysign(value))
    }

    /// Returns the colours of the colour bar as pairs of a position and a colour (red, green, blue). Position 0 is the
    /// bottom of the bar, and 1 is the top. The colour changes linearly between two positions. At each end of a
    /// tolerance band, two colours have the same position, so that the colour changes abruptly.
    pub(super) fn stops(&self) -> Vec<(f64, [u8; 3])> {
        let [low, high] = self.range;
        let place = |value: f64| (value - low) / (high - low);
        let Some(band) = self.tolerance.filter(|band| *band < high) else {
            let steps = self.colours.anchors().len() - 1;
            let value = |k: usize| low + (high - low) * k as f64 / steps as f64;
            return (0..=steps).map(|k| (k as f64 / steps as f64, self.at(value(k)))).collect();
        };
        // Each end of the band has two colours, one for each side.
        let outside = |k: i32| band.next_up() + (high - band) * f64::from(k) / 4.0;
        let below = (0..=4).rev().map(|k| -outside(k));
        let values = below.chain([-band, 0.0, band]).chain((0..=4).map(outside));
        values.map(|value| (place(value).clamp(0.0, 1.0), self.at(value))).collect()
    }

    /// Returns the identifier of the colour gradient in an SVG. Figures in one document that use the same colours share
    /// it.
    pub(super) fn id(&self) -> String {
        match self.tolerance {
            Some(band) => format!("{}-{:.0}", self.colours.id(), 1e4 * band / self.range[1]),
            None => self.colours.id().to_owned(),
        }
    }
}

fn channels(colour: u32) -> [u8; 3] {
    let [_, r, g, b] = colour.to_be_bytes();
    [r, g, b]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn linear(channel: u8) -> f64 {
        let c = f64::from(channel) / 255.0;
        if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    }

    /// Returns CIE L* of an sRGB colour, from 0 to 100.
    fn lightness(colour: [u8; 3]) -> f64 {
        let [r, g, b] = colour.map(linear);
        let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        if y > 0.008856 { 116.0 * y.cbrt() - 16.0 } else { 903.3 * y }
    }

    #[test]
    fn diverging_map_arms_darken_alike() {
        let at = |k: i32| lightness(ColourMap::Diverging.at(0.5 + f64::from(k) / 200.0));
        for k in 0..100 {
            assert!(at(k + 1) < at(k), "red arm at {k}");
            assert!(at(-k - 1) < at(-k), "blue arm at {k}");
            assert!((at(k) - at(-k)).abs() < 5.0, "{k}: {} against {}", at(k), at(-k));
        }
    }

    /// Matrices for linear sRGB as seen with one kind of cones missing: Machado, Oliveira and Fernandes 2009, table 1,
    /// severity 1.
    const EYES: [(&str, [[f64; 3]; 3]); 3] = [
        (
            "protanopia",
            [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        ),
        (
            "deuteranopia",
            [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
        ),
        (
            "tritanopia",
            [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
        ),
    ];

    /// Returns CIE L*a*b* (D65) of a colour as an eye perceives it.
    fn lab(colour: [u8; 3], eye: &[[f64; 3]; 3]) -> [f64; 3] {
        let times = |m: &[[f64; 3]; 3], v: [f64; 3]| m.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
        let seen = times(eye, colour.map(linear)).map(|c| c.clamp(0.0, 1.0));
        let to_xyz =
            [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]];
        let xyz = times(&to_xyz, seen);
        let f = |v: f64| if v > 216.0 / 24389.0 { v.cbrt() } else { (24389.0 / 27.0 * v + 16.0) / 116.0 };
        let [x, y, z] = [f(xyz[0] / 0.95047), f(xyz[1]), f(xyz[2] / 1.08883)];
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    }

    #[test]
    fn diverging_map_for_colour_blindness() {
        for (name, eye) in &EYES {
            let at = |arm: f64| lab(ColourMap::Diverging.at(0.5 + 0.5 * arm), eye);
            for k in 1..=10 {
                let arm = f64::from(k) / 10.0;
                let (proud, low) = (at(arm), at(-arm));
                let apart = (0..3).map(|k| (proud[k] - low[k]).powi(2)).sum::<f64>().sqrt();
                // A difference of 2.3 is just visible. A tenth of the range differs by four times that.
                assert!(apart > 9.2, "{name}, {arm}: {proud:?} against {low:?}, {apart}");
                for sign in [-1.0, 1.0] {
                    let (near, far) = (at(sign * (arm - 0.1)), at(sign * arm));
                    assert!(far[0] < near[0], "{name}: larger is not darker, {near:?} {far:?}");
                }
            }
        }
    }

    #[test]
    fn sequential_map_lightness_monotonic() {
        let at = |k: i32| lightness(ColourMap::Sequential.at(f64::from(k) / 100.0));
        assert!((0..100).all(|k| at(k + 1) > at(k)));
    }

    #[test]
    fn tolerance_band_is_tinted() {
        let tones = Tones::symmetric(10.0, Some(4.0));
        assert_eq!((tones.range, tones.at(0.0)), ([-10.0, 10.0], [0xf7; 3]));
        assert_eq!((tones.at(10.0), tones.at(-99.0)), ([0x67, 0x00, 0x1f], [0x05, 0x30, 0x61]));
        for sign in [-1.0, 1.0] {
            let [inside, outside] = [4.0, 4.01].map(|v| lightness(tones.at(sign * v)));
            assert!(inside > 92.0 && inside - outside > 12.0, "{inside} {outside}");
        }
        // A colour bar always shows its band.
        assert_eq!(Tones::symmetric(1.0, Some(4.0)).range, [-5.0, 5.0]);
        assert_eq!(Tones::symmetric(0.0, None).range, [-1.0, 1.0]);
        let stops = tones.stops();
        assert!(stops.is_sorted_by(|a, b| a.0 <= b.0) && stops[0].0 == 0.0 && stops.last().unwrap().0 == 1.0);
        assert!(stops.iter().filter(|(place, _)| (place - 0.7).abs() < 1e-9).count() == 2, "{stops:?}");
    }

    #[test]
    fn diverging_map_zero_and_ends() {
        assert_eq!(ColourMap::Diverging.at(0.5), [0xf7; 3]);
        assert_eq!(ColourMap::Diverging.at(7.0), [0x67, 0x00, 0x1f]);
        assert_eq!(ColourMap::Diverging.at(-1.0), [0x05, 0x30, 0x61]);
    }
}
