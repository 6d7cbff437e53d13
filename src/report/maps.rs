//! Maps in the report of a run: the first and the last cycle on one scale, and the last cycle on its own scale.

use std::fmt::Write;
use std::path::Path;

use super::convergence::histogram;
use super::heat_map::HeatMap;
use super::run::when;
use super::run_history::RunHistory;
use super::{ReportError, range};
use regrind_formats::{MapNode, escaped, read_error_map};

/// Maximum size of a map of a pair, and of a single map, in pixels of the page.
const OF_A_PAIR: [f64; 2] = [262.0, 262.0];
const ALONE: [f64; 2] = [600.0, 460.0];

/// Width of the axes and the colour bar next to a map of that size, in pixels of the page.
const BESIDE: f64 = 172.0;

/// Map of a cycle with its heading.
struct CycleMap {
    cycle: u32,
    title: String,
    part: String,
    samples_um: Vec<[f64; 3]>,
}

impl CycleMap {
    fn max_magnitude_um(&self) -> f64 {
        let [low, high] = range(self.samples_um.iter().map(|s| s[2]));
        low.abs().max(high.abs())
    }

    /// Returns an HTML figure with the coloured map of this cycle and a caption below the map. The colour scale runs
    /// from `-limit_um` to `limit_um`, in micrometres. `largest` is the maximum width and height of the map in pixels.
    /// The caption is the number of the cycle, followed by `caption`. If the map cannot be drawn, for example because
    /// it has fewer than two nodes, the figure contains the reason instead of the map.
    ///
    /// # Errors
    /// Fails only if the drawing returns [`ReportError::File`]. For every other error of the drawing, the function
    /// returns the figure with the reason.
    fn figure(&self, limit_um: f64, largest: [f64; 2], caption: &str) -> Result<String, ReportError> {
        let width = largest[0] + BESIDE;
        let svg = HeatMap::new(&shortened(&self.title, width, 8.5), "deviation", "\u{b5}m", &self.samples_um)
            .and_then(|map| map.of_nodes().with_max_size(largest).with_limit(limit_um))
            .and_then(|map| map.with_lines(vec![shortened(&self.part, width, 6.8)]).to_svg());
        let drawn = match svg {
            Ok(svg) => within_html(&svg),
            Err(ReportError::File(error)) => return Err(error.into()),
            Err(reason) => format!("<p>No map: {}</p>\n", escaped(&reason.to_string())),
        };
        Ok(format!("<figure>{drawn}<figcaption>Cycle {}, {caption}</figcaption></figure>\n", self.cycle))
    }
}

/// Removes the XML namespace from an SVG, because an SVG within an HTML page does not need it.
pub(super) fn within_html(svg: &str) -> String {
    svg.replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1)
}

/// Cuts a text that is wider than `width`, and ends it with "…". `letter` is the average width of a letter; both are in
/// pixels.
fn shortened(text: &str, width: f64, letter: f64) -> String {
    let most = (width / letter) as usize;
    if text.chars().count() <= most {
        return text.to_owned();
    }
    text.chars().take(most.saturating_sub(1)).chain(['\u{2026}']).collect()
}

/// Returns the HTML section of the filtered error maps. It contains the maps of the first and the last cycle on one
/// colour scale, the map of the last cycle on its own scale, and the histogram of that map. If only one cycle has a
/// map, the pair on one scale is omitted. `folder` is the run folder. Returns an empty text if no cycle has an error map.
///
/// # Errors
/// Fails if the file of an error map cannot be read, or if the histogram cannot be drawn.
pub(super) fn maps(story: &RunHistory, folder: &Path) -> Result<String, ReportError> {
    let mapped = || story.cycles.iter().filter_map(|(cycle, told)| Some((*cycle, told.map.as_ref()?)));
    let Some(last) = mapped().next_back() else { return Ok(String::new()) };
    let first = mapped().next().filter(|(cycle, _)| *cycle != last.0);
    let [part, ..] = story.start.content.names();
    let part = part.unwrap_or("Part");
    let serial = story.begin.as_ref().map_or("", |begin| begin.part.as_str());
    let mark = if story.start.simulation == Some(true) { " (SIMULATION)" } else { "" };
    let read = |(cycle, (name, utc)): (u32, &(String, String))| -> Result<CycleMap, ReportError> {
        let nodes = read_error_map(&folder.join(name))?;
        let samples_um = nodes.iter().map(MapNode::error).map(|[x, y, error_mm]| [x, y, 1e3 * error_mm]).collect();
        let title = format!("Cycle {cycle}, {}{mark}", when(utc));
        Ok(CycleMap { cycle, title, part: format!("{part}, {serial}"), samples_um })
    };
    let (first, last) = (first.map(read).transpose()?, read(last)?);
    let mut html = "<h2>Error of the part, filtered</h2>\n".to_owned();
    if let Some(first) = first {
        let common = first.max_magnitude_um().max(last.max_magnitude_um());
        for drawn in [&first, &last] {
            html += &drawn.figure(common, OF_A_PAIR, "on one scale")?;
        }
    }
    html += &last.figure(last.max_magnitude_um(), ALONE, "on its own scale")?;
    let heading = format!("Cycle {}, {}", last.cycle, last.part);
    let spread = histogram(&shortened(&heading, 460.0, 8.5), &last.samples_um);
    let _ = writeln!(html, "<figure>{}</figure>", within_html(&spread));
    let _ = writeln!(
        html,
        "<p>Red is above the nominal surface, blue is below it, near white is zero. The maps are filtered; PV and RMS of a map \
         are not the judged figures.</p>"
    );
    Ok(html)
}
