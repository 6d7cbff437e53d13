//! Heat maps of a quantity over the part.

use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use regrind_core::geometry::{Aperture, Grid};
use regrind_core::registration::{Deviation, PointStatus};
use regrind_figures::statistics::rms;
use regrind_formats::write_atomic;
use regrind_language::{Language, localised};

use super::axis::{Ruler, Scale, grouped, round_limit, three_digits};
use super::colour::{ColourMap, Tones};
use super::pixels::drawn;
use super::raster::Raster;
use super::svg::{Anchor, Frame, LARGE, SMALL, Svg};
use super::{ReportError, range};

/// Returns the samples with the lowest and the highest value. There must be a sample.
fn extremes(samples: &[[f64; 3]]) -> [[f64; 3]; 2] {
    let by_value = |a: &&[f64; 3], b: &&[f64; 3]| a[2].total_cmp(&b[2]);
    [samples.iter().min_by(by_value), samples.iter().max_by(by_value)].map(|found| found.copied().unwrap_or_default())
}

/// Heat map of scattered samples, with its peak to valley and root mean square.
#[derive(Clone, Debug)]
pub struct HeatMap {
    title: String,
    quantity: String,
    unit: String,
    raster: Raster,
    tones: Tones,
    /// Number of units of the map in a millimetre.
    per_mm: f64,
    pv: f64,
    rms: f64,
    points: usize,
    /// Lines below the title.
    lines: Vec<String>,
    /// Words for the last line: the object that PV and RMS describe, and the name of the counted samples.
    figures_of: [&'static str; 2],
    /// Maximum size of the map on the page, in pixels of the page.
    max_size: [f64; 2],
    /// Samples with the lowest and the highest value: x, y, value.
    extremes: [[f64; 3]; 2],
    /// True if the map is of a simulated part, so the figure is marked.
    is_simulated: bool,
}

impl HeatMap {
    /// Creates a heat map of samples of any quantity. `title` is the title of the figure. `quantity` is the name of the
    /// quantity, and `unit` its unit; both label the colour bar.
    ///
    /// Shapes: two or more samples (x, y, value) in any order. Units: x and y in millimetres, the value in `unit`.
    ///
    /// # Errors
    /// Fails if there are fewer than two samples, if a number is not finite, or if all samples have the same position
    /// (x, y).
    pub fn new(title: &str, quantity: &str, unit: &str, samples: &[[f64; 3]]) -> Result<Self, ReportError> {
        let raster = Raster::new(title, samples)?;
        let [low, high] = range(samples.iter().map(|s| s[2]));
        let map = Self {
            title: title.into(),
            quantity: quantity.into(),
            unit: unit.into(),
            raster,
            tones: Tones { colours: ColourMap::Diverging, range: [low, high], tolerance: None },
            per_mm: 1.0,
            pv: high - low,
            rms: rms(samples.iter().map(|s| s[2])),
            points: samples.len(),
            lines: Vec::new(),
            figures_of: ["", "points"],
            max_size: [WIDTH, HEIGHT],
            extremes: extremes(samples),
            is_simulated: false,
        };
        Ok(map.with_colours(ColourMap::Diverging))
    }

    /// Creates a heat map of lengths. `title` is the title of the figure, and `quantity` is the name of the length on
    /// the colour bar. The map shows micrometres, or nanometres if the peak to valley is below 0.1 µm.
    ///
    /// Shapes: two or more samples (x, y, length) in any order. Units: millimetres.
    ///
    /// # Errors
    /// Fails if there are fewer than two samples, if a number is not finite, or if all samples have the same position
    /// (x, y).
    pub fn of_lengths(title: &str, quantity: &str, samples_mm: &[[f64; 3]]) -> Result<Self, ReportError> {
        let [low, high] = range(samples_mm.iter().map(|s| s[2]));
        let (per_mm, unit) = if high - low < 1e-4 { (1e6, "nm") } else { (1e3, "µm") };
        let samples: Vec<[f64; 3]> = samples_mm.iter().map(|&[x, y, value]| [x, y, value * per_mm]).collect();
        Ok(Self { per_mm, ..Self::new(title, quantity, unit, &samples)? })
    }

    /// Creates a heat map of the deviations of measured points from the nominal surface, after a registration. `title`
    /// is the title of the figure. Each deviation is drawn at the x and y of its contact point. Only inliers are drawn.
    /// Red is above the nominal surface, blue is below it. The map shows micrometres, or nanometres if the peak to
    /// valley is below 0.1 µm.
    ///
    /// Frame: model.
    ///
    /// # Errors
    /// Fails if there are fewer than two inliers, if a number is not finite, or if all inliers have the same position
    /// (x, y).
    pub fn of_deviations(title: &str, deviations: &[Deviation]) -> Result<Self, ReportError> {
        let used = deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let samples: Vec<[f64; 3]> = used.map(|d| [d.point.x, d.point.y, d.deviation_mm]).collect();
        Self::of_lengths(title, "deviation", &samples)
    }

    /// Sets the colours of the heat map, and computes the range of values that the colours show. For
    /// [`ColourMap::Diverging`], the range is symmetric about zero and ends at the largest absolute value of the
    /// pixels. For [`ColourMap::Sequential`], the range goes from the smallest to the largest value of the pixels. If
    /// the range would have no width, it is extended by 1 at both ends. Removes a tolerance that was set before.
    pub fn with_colours(self, colours: ColourMap) -> Self {
        let [low, high] = range(self.raster.values.iter().copied());
        let range = match colours {
            ColourMap::Diverging => [-low.abs().max(high.abs()), low.abs().max(high.abs())],
            ColourMap::Sequential => [low, high],
        };
        // A map with only one value has no range of its own.
        let range = if range[1] > range[0] { range } else { [range[0] - 1.0, range[1] + 1.0] };
        Self { tones: Tones { colours, range, tolerance: None }, ..self }
    }

    /// Sets a tolerance. Values from `-tolerance` to `tolerance` get only a tint (a very light colour), and the colour
    /// bar marks this band. Always uses the diverging colour map, with a range of values that is symmetric about zero.
    /// The range ends at 1.25 times the tolerance or more. A smaller range is extended to this limit.
    ///
    /// Units: millimetres for a map of lengths, otherwise the unit of the map.
    ///
    /// # Errors
    /// Fails if the tolerance is not a finite number above 0.
    pub fn with_tolerance(self, tolerance: f64) -> Result<Self, ReportError> {
        if !(tolerance > 0.0 && tolerance.is_finite()) {
            return Err(ReportError::ColourLimit { figure: self.title, limit: tolerance });
        }
        let [low, high] = self.tones.range;
        let tones = Tones::symmetric(low.abs().max(high.abs()), Some(tolerance * self.per_mm));
        Ok(Self { tones, ..self })
    }

    /// Sets the range of the colours from `-limit` to `limit`, so that maps with the same limit can be compared. Always
    /// uses the diverging colour map. A value beyond the limit gets the colour of the nearer end. A limit of 0 gives
    /// the range from -1 to 1. Removes a tolerance that was set before.
    ///
    /// Units: the unit of the map.
    ///
    /// # Errors
    /// Fails if the limit is negative or not finite.
    pub fn with_limit(self, limit: f64) -> Result<Self, ReportError> {
        if !(limit >= 0.0 && limit.is_finite()) {
            return Err(ReportError::ColourLimit { figure: self.title, limit });
        }
        Ok(Self { tones: Tones::symmetric(limit, None), ..self })
    }

    /// Sets the range of the colours to the first round number beyond the largest magnitude of the samples, as reports and
    /// the page of a cell do. Always uses the diverging colour map. Removes a tolerance that was set before.
    pub fn with_round_limit(self) -> Self {
        let limit = round_limit(self.extremes[0][2].abs().max(self.extremes[1][2].abs()));
        Self { tones: Tones::symmetric(limit, None), ..self }
    }

    /// Sets the lines of text between the title and the summary line with PV and RMS. Replaces lines that were set
    /// before.
    pub fn with_lines(self, lines: Vec<String>) -> Self {
        Self { lines, ..self }
    }

    /// Sets whether the map is of a simulated part. The figure then has the mark SIMULATION in its upper right corner.
    pub fn with_simulation(self, is_simulated: bool) -> Self {
        Self { is_simulated, ..self }
    }

    /// Declares that the samples are nodes of a grid map and not measured points. The summary line below the title then
    /// names PV and RMS as figures of the map, and counts nodes instead of points.
    pub fn of_nodes(self) -> Self {
        Self { figures_of: [" of the map", "nodes"], ..self }
    }

    /// Sets the maximum width and height of the map within the figure, in pixels of the SVG.
    pub fn with_max_size(self, largest: [f64; 2]) -> Self {
        Self { max_size: largest, ..self }
    }

    /// Makes the pixels outside `aperture` transparent. This includes pixels without a sample that were filled from
    /// neighbouring pixels. A pixel remains visible if the distance from its centre to the aperture is at most half the
    /// diagonal of a pixel, because such a pixel can contain a sample on the rim.
    ///
    /// Units: millimetres. Frame: that of the samples.
    pub fn within(mut self, aperture: &Aperture) -> Self {
        let grid = self.raster.grid;
        for (k, value) in self.raster.values.iter_mut().enumerate() {
            let [x, y] = grid.place_mm(k);
            // A sample on the rim fills a pixel that extends half its width beyond the rim.
            if aperture.distance_mm(x, y) > 0.5 * grid.spacing_mm[0].hypot(grid.spacing_mm[1]) {
                *value = f64::NAN;
            }
        }
        self
    }

    /// Returns the upper end of the range of the colours, in the unit of the map.
    pub fn limit(&self) -> f64 {
        self.tones.range[1]
    }

    /// Returns the peak to valley: the largest sample minus the smallest, in the unit of the map.
    pub fn pv(&self) -> f64 {
        self.pv
    }

    /// Returns the root mean square of the samples, in the unit of the map.
    pub fn rms(&self) -> f64 {
        self.rms
    }

    /// Returns the map alone, without axes and text, as a PNG image with 255 colours. Each pixel of the image is one
    /// cell of the grid on which the map averages its samples. The y axis points upwards. Pixels without a value are
    /// transparent.
    ///
    /// # Errors
    /// Fails if the PNG encoder returns an error.
    fn map_png(&self) -> Result<Vec<u8>, ReportError> {
        let mut palette = vec![0; 3];
        let [low, high] = self.tones.range;
        let value = |level: u8| low + (high - low) * f64::from(level) / f64::from(LEVELS - 1);
        palette.extend((0..LEVELS).flat_map(|level| self.tones.at(value(level))));
        let rows = self.raster.values.chunks(self.raster.grid.columns).rev();
        let pixels: Vec<u8> = rows.flatten().map(|&v| self.level(v)).collect();
        let encoded = || {
            let mut bytes = Vec::new();
            let mut encoder =
                png::Encoder::new(&mut bytes, self.raster.grid.columns as u32, self.raster.grid.rows as u32);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_palette(palette);
            encoder.set_trns(vec![0]);
            encoder.set_compression(png::Compression::High);
            let mut writer = encoder.write_header()?;
            writer.write_image_data(&pixels)?;
            writer.finish()?;
            Ok(bytes)
        };
        encoded().map_err(|error: png::EncodingError| self.no_picture(error.to_string()))
    }

    fn no_picture(&self, reason: String) -> ReportError {
        ReportError::Picture { figure: self.title.clone(), reason }
    }

    /// Returns the index of the colour of `value` in the palette of the PNG: 1 to 255 from the lower to the upper end
    /// of the range, or 0 (transparent) for NaN.
    fn level(&self, value: f64) -> u8 {
        if value.is_nan() {
            return 0;
        }
        let [low, high] = self.tones.range;
        let share = (value - low) / (high - low);
        1 + (share.clamp(0.0, 1.0) * f64::from(LEVELS - 1)).round() as u8
    }

    /// Returns the complete figure as SVG: the map within axes in millimetres, a colour bar, the title, and lines of
    /// text with PV and RMS. A map in diverging colours has a cross and the value at its lowest and its highest sample.
    ///
    /// # Errors
    /// Fails if the pixels cannot be encoded.
    pub fn to_svg(&self) -> Result<String, ReportError> {
        // A narrow map must not be narrower than its title and the mark beside it.
        let heading = LARGE_LETTER * self.title.chars().count() as f64 + if self.is_simulated { BADGE } else { 0.0 };
        let room = (self.size()[0] + BESIDE).max(heading);
        let lines = self.lines_within(room);
        let frame = self.frame(lines.len());
        let ([left, top], [width, height]) = (frame.corner, frame.size);
        let mut svg = Svg::new(left + room, top + height + 54.0);
        svg.text([left, 24.0], Anchor::Start, LARGE, &self.title);
        for (line, y) in lines.iter().zip((0..).map(|k| 44.0 + LINE * f64::from(k))) {
            svg.text([left, y], Anchor::Start, SMALL, line);
        }
        let pixel = width / self.raster.grid.columns as f64;
        // Few samples are shown as blocks. Many samples are smoothed when the figure is scaled.
        let rendering = if pixel > 4.0 { "pixelated" } else { "auto" };
        svg.image(frame.corner, frame.size, &STANDARD.encode(self.map_png()?), rendering);
        svg.frame(&frame);
        self.colour_bar(&mut svg, [left + width + 18.0, top], height, None);
        if self.tones.colours == ColourMap::Diverging {
            self.mark_extremes(&mut svg, &frame, Language::En);
        }
        if self.is_simulated {
            svg.badge([left + room - 8.0, 24.0], "SIMULATION");
        }
        Ok(svg.finish())
    }

    /// Returns the map for a page that has its title and its figures around it: the map within axes, a colour bar, and
    /// its lowest and highest sample, each with a cross and its value. Numbers have the decimal sign of `language`.
    ///
    /// # Errors
    /// Fails if the pixels cannot be encoded.
    pub fn to_plain_svg(&self, language: Language) -> Result<String, ReportError> {
        let frame = Frame { corner: [44.0, 8.0], x_label: "mm", y_label: "", ..self.frame_at([44.0, 8.0]) };
        let ([left, top], [width, height]) = (frame.corner, frame.size);
        let mut svg = Svg::new(left + width + 74.0, top + height + 44.0);
        svg.image(frame.corner, frame.size, &STANDARD.encode(self.map_png()?), "auto");
        svg.frame(&frame);
        self.colour_bar(&mut svg, [left + width + 12.0, top], height, Some(language));
        svg.text([left + width + 12.0, top + height + 19.0], Anchor::Start, SMALL, &self.unit);
        self.mark_extremes(&mut svg, &frame, language);
        Ok(svg.finish())
    }

    /// Marks the lowest and the highest sample with a cross and the value. Numbers have the decimal sign of `language`.
    fn mark_extremes(&self, svg: &mut Svg, frame: &Frame, language: Language) {
        let ([left, _], [width, _], rulers) = (frame.corner, frame.size, self.rulers(frame.corner));
        for [x, y, value] in self.extremes {
            let at = [rulers[0].pixel(x), rulers[1].pixel(y)];
            let sign = if value < 0.0 { "\u{2212}" } else { "+" };
            let text = format!("{sign}{}", localised(&three_digits(value.abs()), language));
            svg.cross(at, &text, at[0] > left + 0.8 * width);
        }
    }

    /// Returns the lines of text below the title. The last line is the summary, which contains the figures of the map
    /// and the number of samples. A line that is wider than `width` pixels is broken into several lines.
    fn lines_within(&self, width: f64) -> Vec<String> {
        let summary = self.summary();
        self.lines.iter().chain([&summary]).flat_map(|line| broken(line, (width / LETTER) as usize)).collect()
    }

    fn extent_mm(&self) -> [f64; 2] {
        let Grid { columns, rows, spacing_mm, .. } = self.raster.grid;
        [columns as f64 * spacing_mm[0], rows as f64 * spacing_mm[1]]
    }

    /// Returns width and height of the map within the figure, in pixels of the SVG.
    fn size(&self) -> [f64; 2] {
        let extent_mm = self.extent_mm();
        let scale = (self.max_size[0] / extent_mm[0]).min(self.max_size[1] / extent_mm[1]);
        // A long narrow part is drawn out of scale, because otherwise it would be only a line.
        extent_mm.map(|e| (e * scale).max(90.0))
    }

    fn frame(&self, lines: usize) -> Frame<'static> {
        self.frame_at([66.0, 40.0 + LINE * lines as f64])
    }

    /// Returns the rulers of both axes of a map whose upper left corner is at `corner`.
    fn rulers(&self, corner: [f64; 2]) -> [Ruler; 2] {
        let Grid { first_mm, spacing_mm: pixel_mm, .. } = self.raster.grid;
        let (extent, size) = (self.extent_mm(), self.size());
        let low: [f64; 2] = std::array::from_fn(|k| first_mm[k] - 0.5 * pixel_mm[k]);
        let x = Ruler::new(Scale::Linear, [low[0], low[0] + extent[0]], [corner[0], corner[0] + size[0]]);
        [x, Ruler::new(Scale::Linear, [low[1], low[1] + extent[1]], [corner[1] + size[1], corner[1]])]
    }

    fn frame_at(&self, corner: [f64; 2]) -> Frame<'static> {
        let size = self.size();
        let [x, y] = self.rulers(corner);
        let (x_ticks, y_ticks) = (x.ticks((size[0] / 60.0) as usize), y.ticks((size[1] / 30.0) as usize));
        Frame { corner, size, x_ticks, y_ticks, x_label: "x / mm", y_label: "y / mm", grid: false }
    }

    fn colour_bar(&self, svg: &mut Svg, [left, top]: [f64; 2], height: f64, language: Option<Language>) {
        const BAR: f64 = 16.0;
        svg.gradient(&self.tones.id(), &self.tones.stops());
        svg.rectangle([left, top], [BAR, height], &format!("url(#{})", self.tones.id()));
        let ruler = Ruler::new(Scale::Linear, self.tones.range, [top + height, top]);
        for end in self.tones.tolerance.into_iter().flat_map(|band| [-band, band]) {
            let pixel = ruler.pixel(end);
            svg.line([left - 5.0, pixel], [left + BAR, pixel], super::svg::INK);
        }
        for mut tick in ruler.ticks((height / 36.0) as usize) {
            tick.label = language.map_or(tick.label.clone(), |language| localised(&tick.label, language));
            svg.line([left + BAR, tick.pixel], [left + BAR + 4.0, tick.pixel], super::svg::INK);
            svg.tick_label([left + BAR + 8.0, tick.pixel + 4.0], Anchor::Start, &tick);
        }
        // A map on a page has the unit below its bar.
        if language.is_none() {
            let name = format!("{} / {}", self.quantity, self.unit);
            svg.upright([left + 76.0, top + height / 2.0], &name);
        }
    }

    fn summary(&self) -> String {
        let (unit, [of, counted]) = (&self.unit, self.figures_of);
        let points = format!("{} {counted}", grouped(self.points));
        match self.tones.colours {
            ColourMap::Diverging => {
                let (pv, rms) = (three_digits(self.pv), three_digits(self.rms));
                let summary = format!("PV{of} {pv} {unit}, RMS{of} {rms} {unit}, {points}");
                let Some(band) = self.tones.tolerance else { return summary };
                let share = 100.0 * self.share_within(band);
                format!("{summary}, {share:.1} % of the area within \u{b1} {} {unit}", three_digits(band))
            }
            ColourMap::Sequential => {
                let [low, high] = self.tones.range.map(three_digits);
                format!("{low} to {high} {unit}, {points}")
            }
        }
    }

    /// Returns the share (0 to 1) of the pixels with a value from `-band` to `band`, among all pixels with a value.
    fn share_within(&self, band: f64) -> f64 {
        let known = || self.raster.values.iter().filter(|v| !v.is_nan());
        known().filter(|v| v.abs() <= band).count() as f64 / known().count().max(1) as f64
    }

    /// Saves the complete figure as an SVG file at `path`: the map within axes, a colour bar, the title, and lines of
    /// text with PV and RMS.
    ///
    /// # Errors
    /// Fails if the pixels cannot be encoded or if the file cannot be written.
    pub fn save_svg(&self, path: &Path) -> Result<(), ReportError> {
        Ok(write_atomic(path, self.to_svg()?.as_bytes())?)
    }

    /// Saves the complete figure of [`HeatMap::save_svg`] as a PNG file at `path`, with one and a half times as
    /// many pixels on each side.
    ///
    /// # Errors
    /// Fails if the figure cannot be drawn or if the file cannot be written.
    pub fn save_png(&self, path: &Path) -> Result<(), ReportError> {
        let bytes = drawn(&self.to_svg()?).map_err(|reason| self.no_picture(reason))?;
        Ok(write_atomic(path, &bytes)?)
    }
}

/// Number of colours of the palette. It is odd, so that zero has its own colour.
const LEVELS: u8 = 255;

/// Maximum size of the map on the page, in pixels of the page.
const WIDTH: f64 = 600.0;
const HEIGHT: f64 = 460.0;

/// Width of the colour bar to the right of a map, in pixels of the page.
const BESIDE: f64 = 106.0;

/// Distance between lines of text below the title.
const LINE: f64 = 18.0;

/// Average width of a letter in those lines. It is also sufficient if a wider typeface replaces the intended one.
const LETTER: f64 = 6.8;

/// Average width of a letter of the title, and width of the mark of a simulation with the space around it.
const LARGE_LETTER: f64 = 8.5;
const BADGE: f64 = 126.0;

/// Breaks `line` into several lines of at most `most` characters. Each break is after the last comma that is followed
/// by a space within the first `most` characters. Without such a comma, the break is at the last space within these
/// characters. Without such a space, a long word is broken.
fn broken(line: &str, most: usize) -> Vec<String> {
    let (mut lines, mut rest) = (Vec::new(), line);
    while let Some((end, _)) = rest.char_indices().nth(most) {
        let fits = &rest[..end];
        let at = fits.rfind(", ").map(|at| at + 1).or_else(|| fits.rfind(' ')).filter(|at| *at > 0).unwrap_or(end);
        if at == 0 {
            break;
        }
        lines.push(rest[..at].to_owned());
        rest = rest[at..].trim_start();
    }
    lines.push(rest.to_owned());
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> (png::OutputInfo, Vec<u8>) {
        let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
        decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::ALPHA);
        let mut reader = decoder.read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        (info, pixels)
    }

    /// Three columns and two rows at 1 mm, the upper row last.
    const SMALL_MAP: [[f64; 3]; 6] =
        [[0.0, 0.0, -2e-3], [1.0, 0.0, 0.0], [2.0, 0.0, 2e-3], [0.0, 1.0, 1e-3], [1.0, 1.0, 0.0], [2.0, 1.0, -1e-3]];

    #[test]
    fn png_pixels_of_known_map() {
        let map = HeatMap::of_lengths("known", "height", &SMALL_MAP).unwrap();
        assert_eq!((map.unit.as_str(), map.tones.range), ("µm", [-2.0, 2.0]));
        assert!((map.pv() - 4.0).abs() < 1e-12 && (map.rms() - (10f64 / 6.0).sqrt()).abs() < 1e-12);
        let (info, pixels) = decoded(&map.map_png().unwrap());
        assert_eq!((info.width, info.height), (3, 2));
        let pixel = |i: usize, j: usize| <[u8; 4]>::try_from(&pixels[(j * 3 + i) * 4..][..4]).unwrap();
        // The first row of the picture is the row with the largest y.
        assert_eq!(pixel(0, 1), [0x05, 0x30, 0x61, 255]);
        assert_eq!(pixel(1, 1), [0xf7, 0xf7, 0xf7, 255]);
        assert_eq!(pixel(2, 1), [0x67, 0x00, 0x1f, 255]);
        assert!(pixel(0, 0)[0] > pixel(0, 0)[2] && pixel(2, 0)[2] > pixel(2, 0)[0]);
    }

    #[test]
    fn tolerance_band_tinted_and_labelled() {
        let map = HeatMap::of_lengths("band", "height", &SMALL_MAP).unwrap().with_tolerance(1.5e-3).unwrap();
        assert_eq!((map.limit(), map.tones.tolerance), (2.0, Some(1.5)));
        let (_, pixels) = decoded(&map.map_png().unwrap());
        let pixel = |i: usize, j: usize| <[u8; 4]>::try_from(&pixels[(j * 3 + i) * 4..][..4]).unwrap();
        assert_eq!((pixel(0, 1), pixel(1, 1)), ([0x05, 0x30, 0x61, 255], [0xf7, 0xf7, 0xf7, 255]));
        assert!(pixel(0, 0)[..3].iter().all(|c| *c > 0xe0), "1 um is a tint: {:?}", pixel(0, 0));
        let svg = map.to_svg().unwrap();
        assert!(svg.contains("66.7 % of the area") && svg.contains("\u{b1} 1.50 µm"), "{svg}");
        roxmltree::Document::parse(&svg).unwrap();
        assert!(map.clone().with_tolerance(0.0).is_err() && map.with_tolerance(f64::NAN).is_err());
        // A tolerance beyond all values is still visible.
        let wide = HeatMap::of_lengths("band", "height", &SMALL_MAP).unwrap().with_tolerance(4e-3).unwrap();
        assert_eq!(wide.limit(), 5.0);
        assert!(wide.to_svg().unwrap().contains("100.0 % of the area"));
    }

    #[test]
    fn with_limit_sets_scale_and_labels() {
        let map = HeatMap::new("Cycle 1", "deviation", "µm", &SMALL_MAP).unwrap().of_nodes();
        let map = map.with_limit(8e-3).unwrap().with_lines(vec!["mirror, SN 7".into()]).with_max_size([200.0, 200.0]);
        assert_eq!((map.limit(), map.tones.tolerance), (8e-3, None));
        let svg = map.to_svg().unwrap();
        let document = roxmltree::Document::parse(&svg).unwrap();
        let texts: Vec<_> = document.descendants().filter_map(|n| n.text()).collect();
        for piece in ["Cycle 1", "mirror, SN 7", "map 0.00400 µm", "map 0.00129 µm, 6 nodes", "x / mm"] {
            assert!(texts.iter().any(|text| text.contains(piece)), "{piece} is not in {texts:?}");
        }
        let size = |name: &str| document.root_element().attribute(name).unwrap().parse::<f64>().unwrap();
        assert!(size("width") < 400.0, "{}", size("width"));
        assert!(map.clone().with_limit(f64::NAN).is_err() && map.with_limit(-1.0).is_err());
    }

    #[test]
    fn lines_wrap_at_picture_width() {
        let line = "PV 4.00 µm, RMS 1.29 µm, 6 points";
        assert_eq!(broken(line, 33), [line]);
        assert_eq!(broken(line, 32), ["PV 4.00 µm, RMS 1.29 µm,", "6 points"]);
        assert_eq!(broken(line, 12), ["PV 4.00 µm,", "RMS 1.29", "µm, 6 points"]);
        // A word that is too long is broken.
        assert_eq!((broken("unbroken", 3).concat(), broken("", 5)), ("unbroken".to_owned(), vec![String::new()]));
        let narrow = HeatMap::of_lengths("strip", "height", &SMALL_MAP).unwrap().with_max_size([10.0, 90.0]);
        let narrow = narrow.with_tolerance(1e-3).unwrap();
        let svg = narrow.to_svg().unwrap();
        let document = roxmltree::Document::parse(&svg).unwrap();
        let number = |node: roxmltree::Node, name: &str| node.attribute(name).unwrap().parse::<f64>().unwrap();
        let width = number(document.root_element(), "width");
        let level = document.descendants().filter(|n| n.has_tag_name("text") && n.attribute("transform").is_none());
        for text in level.filter(|n| n.attribute("text-anchor") == Some("start")) {
            let length = text.text().unwrap().chars().count() as f64;
            assert!(number(text, "x") + LETTER * length <= width, "{text:?}");
        }
        assert!(svg.contains("% of the area"), "{svg}");
    }

    #[test]
    fn aperture_masks_outside_pixels() {
        // Without an aperture, a narrow slot between two halves would be filled as a gap.
        let half = |sign: f64| (0..400).map(move |k| [sign * (1.2 + f64::from(k % 20)), f64::from(k / 20), 1e-3]);
        let samples: Vec<[f64; 3]> = half(1.0).chain(half(-1.0)).collect();
        let slot = Aperture::Annulus { centre_mm: [0.0, 10.0], inner_radius_mm: 4.0, outer_radius_mm: 60.0 };
        let map = HeatMap::of_lengths("slot", "height", &samples).unwrap();
        let open = |map: &HeatMap| map.raster.values.iter().filter(|v| v.is_nan()).count();
        let (before, after) = (open(&map), open(&map.clone().within(&slot)));
        assert!(before == 0 && after > 20, "{before} {after}");
    }

    #[test]
    fn unmeasured_pixels_are_transparent() {
        let ring = |i: i32, j: i32| (100..=400).contains(&((i - 20).pow(2) + (j - 20).pow(2)));
        let samples: Vec<[f64; 3]> = (0..41)
            .flat_map(|j| (0..41).map(move |i| (i, j)))
            .filter(|&(i, j)| ring(i, j))
            .map(|(i, j)| [f64::from(i), f64::from(j), 1e-6 * f64::from(i)])
            .collect();
        let map = HeatMap::of_lengths("ring", "height", &samples).unwrap();
        assert_eq!(map.unit, "nm");
        let (info, pixels) = decoded(&map.map_png().unwrap());
        let alpha = |i: u32, j: u32| pixels[((j * info.width + i) * 4 + 3) as usize];
        assert_eq!([alpha(0, 0), alpha(info.width / 2, info.height / 2)], [0, 0]);
        assert_eq!(alpha(1, info.height / 2), 255);
    }

    #[test]
    fn svg_well_formed_and_deterministic() {
        let map = HeatMap::of_lengths("1 < 2 & more", "height", &SMALL_MAP).unwrap();
        let svg = map.to_svg().unwrap();
        assert_eq!(svg, map.to_svg().unwrap());
        let document = roxmltree::Document::parse(&svg).unwrap();
        let texts: Vec<_> = document.descendants().filter_map(|n| n.text()).collect();
        for piece in ["1 < 2 & more", "PV 4.00 µm", "RMS 1.29 µm", "6 points", "x / mm", "height / µm"] {
            assert!(texts.iter().any(|text| text.contains(piece)), "{piece} is not in {texts:?}");
        }
        let image = document.descendants().find(|n| n.has_tag_name("image")).unwrap();
        let data = image.attribute("href").unwrap().strip_prefix("data:image/png;base64,").unwrap();
        assert_eq!(STANDARD.decode(data).unwrap(), map.map_png().unwrap());
    }

    #[test]
    fn heat_map_refuses_nan() {
        let mut samples = SMALL_MAP;
        samples[4][2] = f64::NAN;
        let error = HeatMap::of_lengths("map", "height", &samples).unwrap_err();
        assert!(matches!(error, ReportError::NotFinite { index: 4, what: "value", .. }), "{error}");
    }

    #[test]
    fn a_flat_map_is_drawn() {
        let flat: Vec<[f64; 3]> = SMALL_MAP.iter().map(|&[x, y, _]| [x, y, 0.0]).collect();
        let map = HeatMap::of_lengths("flat", "height", &flat).unwrap();
        assert!(map.to_svg().unwrap().contains("PV 0 nm"));
        assert!(map.with_colours(ColourMap::Sequential).to_svg().is_ok());
    }

    #[test]
    fn heat_map_save_svg_and_png() {
        let folder = tempfile::tempdir().unwrap();
        let map = HeatMap::of_lengths("map", "height", &SMALL_MAP).unwrap();
        map.save_svg(&folder.path().join("a.svg")).unwrap();
        map.save_png(&folder.path().join("a.png")).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
        // The map is in the picture, not only its scale, which has 2 % of the pixels.
        let (_, pixels) = decoded(&std::fs::read(folder.path().join("a.png")).unwrap());
        let is_coloured = |p: &[u8]| p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2])) > 40;
        let coloured = pixels.chunks_exact(4).filter(|pixel| is_coloured(pixel)).count();
        assert!(coloured > pixels.len() / 4 / 10, "{coloured} of {} pixels", pixels.len() / 4);
        let error = map.save_png(&folder.path().join("none/a.png")).unwrap_err();
        assert!(matches!(error, ReportError::File(_)), "{error}");
    }
}
