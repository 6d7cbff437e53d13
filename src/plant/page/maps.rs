//! `/maps`: error maps of runs side by side, on one colour scale.

use std::path::Path;

use axum::extract::{RawQuery, State};
use axum::response::Response;
use data_encoding::HEXLOWER;
use maud::{Markup, PreEscaped, html};
use regrind_formats::{MapNode, parse_error_map};
use regrind_language::{Language, decimal, filled};
use regrind_page::Reader;
use regrind_report::HeatMap;
use tokio::task::spawn_blocking;

use super::super::copy::content;
use super::super::link::DatabaseLink;
use super::content::{PageContent, page};
use super::page_error::{Message, PageError};
use super::selection::mark;
use super::shared::Shared;
use super::texts::Text;
use super::words::{name, shown, um};

/// Maximum number of maps on the page.
const MAX_MAPS: usize = 4;
/// Maximum size of a map, in pixels of the page: of one among others, and of one alone.
const MAX_SIZE_PX: [f64; 2] = [400.0, 400.0];
const MAX_SIZE_ALONE_PX: [f64; 2] = [440.0, 380.0];

/// Requested map: a run and a cycle; without a cycle, the last cycle of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MapRequest {
    pub(super) run: i32,
    pub(super) cycle: Option<i32>,
}

/// Map with its run.
pub(super) struct Map {
    run: i32,
    pub(super) cycle: i32,
    serial: String,
    cell: String,
    recipe: String,
    simulation: bool,
    pv_um: Option<f64>,
    rms_um: Option<f64>,
    /// Samples (x, y, error), in mm, mm and µm; otherwise the reason why there are none.
    samples: Result<Vec<[f64; 3]>, NoMap>,
}

/// Reason why there are no samples of a map.
#[derive(Clone, Debug, PartialEq, Eq)]
enum NoMap {
    /// The plant has no such map.
    Missing,
    /// The file of the map is not on record, or several files have its name.
    NotOnRecord,
    /// The file has not arrived at the plant yet.
    NotArrived,
    /// The plant's copy of the file has another hash than the one on record.
    Changed,
    /// The content of the file cannot be read; the reason in English.
    Unreadable(String),
}

impl NoMap {
    fn to(&self, language: Language) -> String {
        let text = match self {
            Self::Missing => Text::MapMissing,
            Self::NotOnRecord => Text::MapNotOnRecord,
            Self::NotArrived => Text::MapNotArrived,
            Self::Changed => Text::MapChanged,
            Self::Unreadable(reason) => return shown(reason),
        };
        text.to(language).to_owned()
    }
}

pub(super) async fn maps(State(plant): State<Shared>, reader: Reader, RawQuery(query): RawQuery) -> Response {
    let asked = parse_requests(query.as_deref().unwrap_or_default());
    page(&reader, made(&plant, &asked, reader.language)).await
}

/// Parses the query of an address, such as `run=17&run=18:2`, into a list of requested maps. Each `run` is the id of a
/// run, optionally with the number of a cycle after a colon. Ignores other parameters and invalid values. Returns at
/// most four requests.
fn parse_requests(query: &str) -> Vec<MapRequest> {
    let named = query.split('&').filter_map(|pair| pair.strip_prefix("run="));
    let one = |text: &str| {
        let text = text.replace("%3A", ":").replace("%3a", ":");
        let (run, cycle) = text.split_once(':').map_or((text.as_str(), None), |(run, cycle)| (run, Some(cycle)));
        Some(MapRequest { run: run.parse().ok()?, cycle: cycle.map(str::parse).transpose().ok()? })
    };
    named.filter_map(one).take(MAX_MAPS).collect()
}

async fn made(plant: &Shared, asked: &[MapRequest], language: Language) -> Result<PageContent, PageError> {
    let say = |text: Text| text.to(language);
    if asked.is_empty() {
        return Err(PageError::Nonsense(Message::Text(Text::NameTheRuns, Vec::new())));
    }
    let mut maps = Vec::new();
    {
        let link = plant.lease().await?;
        for one in asked {
            maps.push(read(plant, &link, *one).await?);
        }
    }
    let drawn = spawn_blocking(move || side_by_side(&maps, language)).await;
    let main = html! {
        main .list .plant {
            h1 { (say(Text::Maps)) }
            (drawn.unwrap_or_default())
        }
    };
    Ok(PageContent { title: say(Text::Maps).into(), again_s: None, main })
}

/// Reads a map with its run from the plant.
pub(super) async fn read(plant: &Shared, link: &DatabaseLink, asked: MapRequest) -> Result<Map, PageError> {
    let text = "SELECT cycle, serial, cell, recipe, simulation, pv_um, rms_um, map FROM cycle_figure
        WHERE run_id = $1 AND map IS NOT NULL AND ($2::integer IS NULL OR cycle = $2) ORDER BY cycle DESC LIMIT 1";
    let rows = link.query(text, &[&asked.run, &asked.cycle]).await?;
    let Some(row) = rows.first() else { return without(link, asked).await };
    let words = |k: usize| row.get::<_, Option<String>>(k).unwrap_or_default();
    let name = words(7);
    Ok(Map {
        run: asked.run,
        cycle: row.get(0),
        serial: words(1),
        cell: words(2),
        recipe: words(3),
        simulation: row.get::<_, Option<bool>>(4) == Some(true),
        pv_um: row.get(5),
        rms_um: row.get(6),
        samples: samples(plant, link, asked.run, &name).await?,
    })
}

/// Returns the entry on the page for a requested error map that the plant does not have. `asked` names the run and the
/// cycle of the map. The entry contains the data of the run, and a text with the reason instead of the samples. The
/// page can then show this run next to runs with a map.
///
/// Returns an error if the plant has no run with the id `asked.run` that made a part, or if the plant cannot be
/// reached.
async fn without(link: &DatabaseLink, asked: MapRequest) -> Result<Map, PageError> {
    let text = "SELECT serial, cell, recipe, simulation, pv_um, rms_um FROM part_run WHERE id = $1";
    let rows = link.query(text, &[&asked.run]).await?;
    let row = rows.first().ok_or_else(|| PageError::no_run(asked.run))?;
    let words = |k: usize| row.get::<_, Option<String>>(k).unwrap_or_default();
    Ok(Map {
        run: asked.run,
        cycle: asked.cycle.unwrap_or(0),
        serial: words(0),
        cell: words(1),
        recipe: words(2),
        simulation: row.get::<_, Option<bool>>(3) == Some(true),
        pv_um: row.get(4),
        rms_um: row.get(5),
        samples: Err(NoMap::Missing),
    })
}

/// Reads the error map in the file `name` of the run with the id `run`. Each sample is `[x, y, error]`, with x and y in
/// mm and the error in µm.
///
/// The inner `Err` is the reason why the map cannot be shown, for example because its file has not arrived at the plant. The outer `Err` means that the plant could not answer the query.
async fn samples(
    plant: &Shared,
    link: &DatabaseLink,
    run: i32,
    name: &str,
) -> Result<Result<Vec<[f64; 3]>, NoMap>, PageError> {
    let rows = link.query("SELECT sha256 FROM run_artefact WHERE run = $1 AND name = $2", &[&run, &name]).await?;
    let [row] = &rows[..] else { return Ok(Err(NoMap::NotOnRecord)) };
    let sha256: Vec<u8> = row.get(0);
    let Some(content) = content(link, plant.artefacts.as_ref(), &sha256).await? else {
        return Ok(Err(NoMap::NotArrived));
    };
    if regrind_journal::sha256_hex(&content) != HEXLOWER.encode(&sha256) {
        return Ok(Err(NoMap::Changed));
    }
    let name = name.to_owned();
    let parsed = spawn_blocking(move || {
        let text = String::from_utf8(content).map_err(|_| "its file is not text".to_owned())?;
        let nodes = parse_error_map(Path::new(&name), &text).map_err(|error| error.to_string())?;
        Ok(nodes.iter().map(MapNode::error).map(|[x, y, error_mm]| [x, y, 1e3 * error_mm]).collect())
    });
    let parsed: Result<_, String> = parsed.await.unwrap_or_else(|_| Err("it could not be read".into()));
    Ok(parsed.map_err(NoMap::Unreadable))
}

/// Draws error maps next to each other with one common colour scale. The scale is symmetric about zero, and its limit
/// is the largest absolute error of all maps in µm. A map without samples is replaced by the reason.
fn side_by_side(maps: &[Map], language: Language) -> Markup {
    let all = maps.iter().filter_map(|map| map.samples.as_ref().ok()).flatten();
    let limit = all.fold(0.0_f64, |most, sample| most.max(sample[2].abs()));
    html! {
        div .maps {
            @for map in maps {
                figure data-run=(map.run) {
                    figcaption {
                        a href=(format!("/runs/{}", map.run)) { (name(&map.serial)) } @if map.cycle > 0 { ", " (Text::Cycle.to(language)) " " (map.cycle) } ", " (name(&map.cell)) ", " (name(&map.recipe)) " " (mark(map.simulation, language))
                        br; (Text::JudgedAs.to(language)) " PV " (um(map.pv_um, 2, language)) " µm, RMS " (um(map.rms_um, 3, language)) " µm"
                    }
                    (drawn(map, MAX_SIZE_PX, limit, language))
                }
            }
        }
        p .quiet {
            (filled(Text::OneScale.to(language), &[("limit", &decimal(limit, 2, language))])) " " (Text::SignOfMaps.to(language)) " " (Text::HashOfMaps.to(language))
        }
    }
}

/// Draws the map of a run alone, with the scale of its largest error, and says what the colours mean.
pub(super) fn map_of_run(map: &Map, language: Language) -> Markup {
    let limit = map.samples.iter().flatten().fold(0.0_f64, |most, sample| most.max(sample[2].abs()));
    html! {
        figure .wide data-run=(map.run) data-cycle=(map.cycle) { (drawn(map, MAX_SIZE_ALONE_PX, limit, language)) }
        p .quiet { (Text::SignOfMaps.to(language)) }
    }
}

fn drawn(map: &Map, max_size: [f64; 2], limit_um: f64, language: Language) -> Markup {
    let svg = map.samples.as_ref().map_err(|reason| reason.to(language)).and_then(|samples| {
        let heat = HeatMap::new("", "", "\u{b5}m", samples)
            .and_then(|heat| heat.of_nodes().with_max_size(max_size).with_limit(limit_um));
        heat.and_then(|heat| heat.to_plain_svg(language)).map_err(|error| shown(&error.to_string()))
    });
    match svg {
        // The content policy of the page forbids inline styles, so the style becomes an attribute with the same effect.
        Ok(svg) => PreEscaped(
            svg.replace(" style=\"image-rendering:pixelated\"", " image-rendering=\"pixelated\"")
                .replace(" style=\"image-rendering:auto\"", ""),
        ),
        Err(reason) => html! { p .no { (Text::NoMap.to(language)) " " (reason) } },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn query_accepts_run_numbers_only() {
        let of = |run, cycle| MapRequest { run, cycle };
        assert_eq!(parse_requests("run=17&run=18:2&run=9%3A1&x=3"), [of(17, None), of(18, Some(2)), of(9, Some(1))]);
        assert_eq!(parse_requests("run=1;DROP&run=&run=%3A&run=1:x"), []);
        assert_eq!(parse_requests(&"run=1&".repeat(9)).len(), MAX_MAPS);
    }

    #[test]
    fn maps_use_one_scale_and_show_errors() {
        let map = |um: f64, samples: bool| Map {
            run: 1,
            cycle: 2,
            serial: "<b>".into(),
            cell: "c".into(),
            recipe: "r".into(),
            simulation: true,
            pv_um: Some(3.0),
            rms_um: None,
            samples: if samples {
                Ok((0..25).map(|k| [f64::from(k % 5), f64::from(k / 5), um * f64::from(k) / 24.0]).collect())
            } else {
                Err(NoMap::Unreadable("<i>gone".into()))
            },
        };
        let html = side_by_side(&[map(1.0, true), map(-4.0, true), map(0.0, false)], Language::En).into_string();
        assert!(html.contains("± 4.00 µm") && html.contains("&lt;i&gt;gone") && !html.contains("<b>"), "{html}");
        assert_eq!(html.matches("<svg").count(), 2);
        assert!(!html.contains("style="), "the page takes none");
    }
}
