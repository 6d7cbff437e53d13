//! SVG elements that figures are made of.

use std::fmt::Write;

use super::axis::Tick;
use regrind_formats::escaped;

/// Colour of axes and text.
pub(super) const INK: &str = "#222222";
/// Colour of grid lines.
pub(super) const FAINT: &str = "#dddddd";
/// Size of labels in pixels.
pub(super) const SMALL: f64 = 12.0;
/// Size of titles in pixels.
pub(super) const LARGE: f64 = 15.0;

/// SVG document that is being written: coordinates in pixels, y downwards, two decimals.
#[derive(Debug)]
pub(super) struct Svg {
    text: String,
}

/// Alignment of a text relative to its place.
#[derive(Clone, Copy, Debug)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

impl Anchor {
    fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Middle => "middle",
            Self::End => "end",
        }
    }
}

/// Rectangle with ticks on its left and lower side.
#[derive(Debug)]
pub(super) struct Frame<'a> {
    /// Upper left corner.
    pub(super) corner: [f64; 2],
    /// Width and height.
    pub(super) size: [f64; 2],
    pub(super) x_ticks: Vec<Tick>,
    pub(super) y_ticks: Vec<Tick>,
    pub(super) x_label: &'a str,
    pub(super) y_label: &'a str,
    /// True if grid lines cross the frame at the ticks.
    pub(super) grid: bool,
}

impl Svg {
    /// Creates an SVG document of `width` by `height` pixels with a white background.
    pub(super) fn new(width: f64, height: f64) -> Self {
        let mut svg = Self { text: String::new() };
        svg.put(format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" \
             viewBox=\"0 0 {width:.0} {height:.0}\" font-family=\"Helvetica, Arial, sans-serif\" font-size=\"{SMALL}\" \
             fill=\"{INK}\">\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
        ));
        svg
    }

    /// Ends the document and returns its text.
    pub(super) fn finish(mut self) -> String {
        self.text.push_str("</svg>\n");
        self.text
    }

    fn put(&mut self, arguments: std::fmt::Arguments) {
        self.text.write_fmt(arguments).expect("writing to a string cannot fail");
    }

    pub(super) fn line(&mut self, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2], colour: &str) {
        self.put(format_args!(
            "<line x1=\"{x1:.2}\" y1=\"{y1:.2}\" x2=\"{x2:.2}\" y2=\"{y2:.2}\" stroke=\"{colour}\"/>\n"
        ));
    }

    /// Draws a rectangle with a thin outline. `[x, y]` is its upper left corner; `fill` is a colour, or "none".
    pub(super) fn rectangle(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], fill: &str) {
        self.put(format_args!(
            "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" fill=\"{fill}\" stroke=\"{INK}\"/>\n"
        ));
    }

    pub(super) fn polyline(&mut self, points: &[[f64; 2]], colour: &str, dashes: &str) {
        let mut list = String::with_capacity(points.len() * 14);
        for [x, y] in points {
            write!(list, "{x:.2},{y:.2} ").expect("writing to a string cannot fail");
        }
        self.put(format_args!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\" stroke-dasharray=\"{dashes}\"/>\n",
            list.trim_end()
        ));
    }

    /// Draws a quadratic Bézier curve from (x1, y1) to (x2, y2) with the control point (cx, cy), and an arrow head at
    /// its end.
    pub(super) fn arrow(&mut self, [x1, y1]: [f64; 2], [cx, cy]: [f64; 2], [x2, y2]: [f64; 2], colour: &str) {
        let (dx, dy) = if (cx - x2).hypot(cy - y2) > 1.0 { (x2 - cx, y2 - cy) } else { (x2 - x1, y2 - y1) };
        let length = dx.hypot(dy).max(f64::MIN_POSITIVE);
        let [ux, uy] = [7.0 * dx / length, 7.0 * dy / length];
        let [lx, ly, rx, ry] = [x2 - ux - 0.4 * uy, y2 - uy + 0.4 * ux, x2 - ux + 0.4 * uy, y2 - uy - 0.4 * ux];
        self.put(format_args!(
            "<path d=\"M{x1:.2},{y1:.2}Q{cx:.2},{cy:.2} {x2:.2},{y2:.2}\" fill=\"none\" stroke=\"{colour}\"/>\n\
             <path d=\"M{x2:.2},{y2:.2}L{lx:.2},{ly:.2}L{rx:.2},{ry:.2}z\" fill=\"{colour}\"/>\n"
        ));
    }

    /// Draws a nearly opaque white rectangle, as a background for a label over earlier drawing. `[x, y]` is its upper
    /// left corner.
    pub(super) fn plate(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2]) {
        self.put(format_args!(
            "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" fill=\"#ffffff\" \
             fill-opacity=\"0.85\"/>\n"
        ));
    }

    /// Draws the text `content` in a colour. `[x, y]` is the middle of its base line, `size` its font size in pixels.
    pub(super) fn coloured_text(&mut self, [x, y]: [f64; 2], size: f64, content: &str, colour: &str) {
        let content = escaped(content);
        self.put(format_args!(
            "<text x=\"{x:.2}\" y=\"{y:.2}\" text-anchor=\"middle\" font-size=\"{size}\" fill=\"{colour}\">{content}</text>\n"
        ));
    }

    /// Draws a text in a frame. `[x, y]` is the right end of its base line.
    pub(super) fn badge(&mut self, [x, y]: [f64; 2], content: &str) {
        // Bold capitals are about this wide.
        let width = 8.6 * content.chars().count() as f64 + 12.0;
        let content = escaped(content);
        self.put(format_args!(
            "<rect x=\"{:.2}\" y=\"{:.2}\" width=\"{width:.2}\" height=\"20\" rx=\"4\" fill=\"none\" stroke=\"{INK}\" stroke-width=\"1.5\"/>\n\
             <text x=\"{:.2}\" y=\"{y:.2}\" text-anchor=\"middle\" font-weight=\"600\">{content}</text>\n",
            x - width,
            y - 14.5,
            x - width / 2.0
        ));
    }

    /// Draws a cross at `[x, y]` with a text beside it, both on a white edge so that they are seen on any colour. The text
    /// is to the left of the cross if `is_left` is true.
    pub(super) fn cross(&mut self, [x, y]: [f64; 2], content: &str, is_left: bool) {
        let path = format!("M{:.2},{:.2}l8,8m0,-8l-8,8", x - 4.0, y - 4.0);
        let (at, anchor) = if is_left { (x - 8.0, "end") } else { (x + 8.0, "start") };
        let content = escaped(content);
        for (colour, wide) in [("#ffffff", 4.0), (INK, 1.3)] {
            self.put(format_args!("<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{wide}\"/>\n"));
        }
        self.put(format_args!(
            "<text x=\"{at:.2}\" y=\"{:.2}\" text-anchor=\"{anchor}\" stroke=\"#ffffff\" stroke-width=\"3\" \
             paint-order=\"stroke\" stroke-linejoin=\"round\">{content}</text>\n",
            y + 4.0
        ));
    }

    /// Draws a rectangle around the plotting area, the ticks of the x axis below it and the ticks of the y axis on its
    /// left, with their labels, and the labels of both axes. If `frame.grid` is true, grid lines cross the rectangle at
    /// the ticks.
    pub(super) fn frame(&mut self, frame: &Frame) {
        let Frame { corner: [left, top], size: [width, height], .. } = *frame;
        let (right, bottom) = (left + width, top + height);
        let end = |grid: bool, far: f64, near: f64| if grid { far } else { near };
        let ink = if frame.grid { FAINT } else { INK };
        for tick in &frame.x_ticks {
            self.line([tick.pixel, bottom], [tick.pixel, end(frame.grid, top, bottom + 5.0)], ink);
            self.tick_label([tick.pixel, bottom + 19.0], Anchor::Middle, tick);
        }
        for tick in &frame.y_ticks {
            self.line([left, tick.pixel], [end(frame.grid, right, left - 5.0), tick.pixel], ink);
            self.tick_label([left - 8.0, tick.pixel + 4.0], Anchor::End, tick);
        }
        self.rectangle([left, top], [width, height], "none");
        self.text([left + width / 2.0, bottom + 39.0], Anchor::Middle, SMALL, frame.x_label);
        if !frame.y_label.is_empty() {
            self.upright([left - 46.0, top + height / 2.0], frame.y_label);
        }
    }

    /// Draws the text `content` in one line. `anchor` selects the start, the middle or the end of the baseline, and
    /// `[x, y]` is the position of this point in pixels. `size` is the font size in pixels.
    pub(super) fn text(&mut self, [x, y]: [f64; 2], anchor: Anchor, size: f64, content: &str) {
        let (anchor, content) = (anchor.name(), escaped(content));
        self.put(format_args!(
            "<text x=\"{x:.2}\" y=\"{y:.2}\" text-anchor=\"{anchor}\" font-size=\"{size}\">{content}</text>\n"
        ));
    }

    /// Draws a text that is rotated by a quarter turn and reads upwards. `[x, y]` is the middle of its base line.
    pub(super) fn upright(&mut self, [x, y]: [f64; 2], content: &str) {
        let content = escaped(content);
        self.put(format_args!(
            "<text transform=\"translate({x:.2} {y:.2}) rotate(-90)\" text-anchor=\"middle\">{content}</text>\n"
        ));
    }

    /// Draws the label of `tick`, such as "10". If the tick has an exponent, it is drawn as a superscript after the
    /// label. `anchor` selects the start, the middle or the end of the baseline, and `at` is the position of this point
    /// in pixels.
    pub(super) fn tick_label(&mut self, at: [f64; 2], anchor: Anchor, tick: &Tick) {
        let Some(exponent) = tick.exponent else { return self.text(at, anchor, SMALL, &tick.label) };
        let ([x, y], anchor, exponent) = (at, anchor.name(), exponent.to_string().replace('-', "\u{2212}"));
        self.put(format_args!(
            "<text x=\"{x:.2}\" y=\"{y:.2}\" text-anchor=\"{anchor}\">{}<tspan dy=\"-5\" font-size=\"9\">{exponent}</tspan>\
             </text>\n",
            escaped(&tick.label)
        ));
    }

    /// Draws a PNG, stretched to a rectangle. `[x, y]` is the upper left corner, `base64` the PNG in base 64, and
    /// `rendering` the CSS property `image-rendering`.
    pub(super) fn image(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], base64: &str, rendering: &str) {
        self.put(format_args!(
            "<image x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" preserveAspectRatio=\"none\" \
             style=\"image-rendering:{rendering}\" href=\"data:image/png;base64,{base64}\"/>\n"
        ));
    }

    /// Defines a vertical colour gradient with the identifier `id`. Shapes can use the gradient as the fill `url(#id)`.
    /// `stops` are pairs of a position and the colour (red, green, blue) at this position. Position 0 is the bottom,
    /// and 1 is the top.
    pub(super) fn gradient(&mut self, id: &str, stops: &[(f64, [u8; 3])]) {
        self.put(format_args!("<defs><linearGradient id=\"{id}\" x1=\"0\" y1=\"1\" x2=\"0\" y2=\"0\">"));
        for (offset, [r, g, b]) in stops {
            self.put(format_args!("<stop offset=\"{offset:.4}\" stop-color=\"#{r:02x}{g:02x}{b:02x}\"/>"));
        }
        self.put(format_args!("</linearGradient></defs>\n"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn svg_escapes_any_text() {
        let mut svg = Svg::new(100.0, 50.0);
        let odd = "a < b & \"c\" > \u{1} \u{ffff} µm";
        svg.text([1.0, 2.0], Anchor::End, SMALL, odd);
        svg.upright([3.0, 4.0], odd);
        svg.gradient("g", &[(0.0, [0; 3]), (1.0, [255; 3])]);
        svg.tick_label([0.0, 0.0], Anchor::Start, &Tick { pixel: 0.0, label: "10".into(), exponent: Some(-3) });
        let text = svg.finish();
        let document = roxmltree::Document::parse(&text).unwrap();
        let first = document.descendants().find(|n| n.has_tag_name("text")).unwrap();
        assert_eq!(first.text(), Some("a < b & \"c\" > \u{fffd} \u{fffd} µm"));
    }
}
