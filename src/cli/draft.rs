//! `regrind draft`: what the page shows of a recipe that is being written: its problems, its plan and its shape.
//!
//! The page starts this command for each text, so that a large file, or a fault of the program, stops neither the page
//! nor a cell. The text comes from standard input. Each result is a line of JSON as soon as it is known:
//!
//! ```text
//!  checked  problems with their places, notes            always
//!  planned  the document of `regrind plan`               if there is no problem
//!  refused  the reason why no run can be planned         in place of `planned`
//!  shape    surface, targets, tracks and scallops        after `planned`
//! ```

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::compensation::path::ToolPath;
use regrind::config::{BUILT_IN_CELL, CellConfig};
use regrind::document::Problems;
use regrind::drive::{Programs, Task};
use regrind::formats::RecipeFolder;
use regrind::recipe::{NominalSource, Recipe};
use regrind::surface::Nominal;
use serde::Serialize;

use super::check::{ProblemDocument, with_good_files};
use super::failure::Failure;
use super::outcome::FAULT;
use super::plan::{PlanDocument, PlannedRun};
use super::run_plan::path_picture;
use super::{Outcome, outside};

/// Maximum number of columns and rows of the surface, of targets, of tracks, and of points of all tracks.
const MAX_NODES: usize = 97;
const MAX_TARGETS: usize = 450;
const MAX_TRACKS: usize = 24;
const MAX_TRACK_POINTS: usize = 12_000;

/// Print what the page shows of a recipe that is being written
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Path of the recipe; its text comes from standard input
    #[arg(value_name = "RECIPE")]
    recipe: PathBuf,
    /// Cell that would make the part
    #[arg(long, value_name = "FILE", default_value = BUILT_IN_CELL)]
    cell: PathBuf,
}

/// One line of the output.
#[derive(Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum Line<'a> {
    Checked { problems: Vec<ProblemDocument>, notes: &'a [String] },
    Planned { plan: &'a PlanDocument },
    Refused { reason: String },
    Shape(Box<Shape>),
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    outside::give_way_to_all();
    outside::end_with_reader(FAULT.into());
    let mut text = String::new();
    // A longer text is a text with a problem, so one byte more than allowed is enough.
    io::stdin().take(RecipeFolder::MAX_BYTES + 1).read_to_string(&mut text).map_err(Failure::Terminal)?;
    let recipe = match checked(arguments, &text) {
        Ok(recipe) => recipe,
        Err(problems) => {
            super::print_json_line(&Line::Checked { problems: ProblemDocument::all(&problems), notes: &[] })?;
            return Ok(Outcome::NotInTolerance);
        }
    };
    super::print_json_line(&Line::Checked { problems: Vec::new(), notes: recipe.notes() })?;
    let planned = CellConfig::read(&arguments.cell)
        .map_err(|problems| problems.to_string())
        .and_then(|cell| PlannedRun::new(&recipe, &cell).map_err(|failure| failure.to_string()));
    let PlannedRun { document, task, path } = match planned {
        Ok(planned) => planned,
        Err(reason) => {
            super::print_json_line(&Line::Refused { reason })?;
            return Ok(Outcome::NotInTolerance);
        }
    };
    super::print_json_line(&Line::Planned { plan: &document })?;
    let shape = Shape::new(&task, path.as_ref().map(|(path, _)| path));
    super::print_json_line(&Line::Shape(Box::new(shape)))?;
    Ok(Outcome::Accepted)
}

fn checked(arguments: &Arguments, text: &str) -> Result<Recipe, Problems> {
    if text.len() as u64 > RecipeFolder::MAX_BYTES {
        let found = format!("the text is longer than {} bytes", RecipeFolder::MAX_BYTES);
        return Err(Problems::whole(&arguments.recipe, text, found, "keep points and maps in files of their own"));
    }
    read_draft(&arguments.recipe, text).and_then(with_good_files)
}

/// Reads a recipe that a browser has sent as `text`. It can name only files below the folder of the recipe at `path`:
/// the messages about a file quote it, and a person at a browser must not read other files of this computer.
///
/// # Errors
/// Returns the problems of the text, and those of files elsewhere.
pub(super) fn read_draft(path: &Path, text: &str) -> Result<Recipe, Problems> {
    let recipe = Recipe::parse(path, text)?;
    let folder = path.parent().and_then(|folder| folder.canonicalize().ok());
    // A file that does not exist is where its folder is: whether files exist elsewhere is not told.
    let place = |file: &Path| file.ancestors().find_map(|above| above.canonicalize().ok());
    let is_elsewhere = |file: &&Path| match (place(file), &folder) {
        (Some(place), Some(folder)) => !place.starts_with(folder),
        _ => true,
    };
    let of_nominal = matches!(&recipe.nominal, NominalSource::File { path, .. } if is_elsewhere(&path.as_path()));
    let key = if of_nominal { "nominal.file" } else { "measure.file" };
    match recipe.files().into_iter().find(is_elsewhere) {
        None => Ok(recipe),
        Some(file) => {
            let found = format!("is {}, which is not below the folder of the recipes", file.display());
            Err(recipe.problem(key, &found, "", "move the file to the recipes, or write this recipe with an editor"))
        }
    }
}

/// Shape of the part for a picture. Lengths are in millimetres, model frame.
#[derive(Serialize)]
struct Shape {
    columns: usize,
    rows: usize,
    first_mm: [f64; 2],
    spacing_mm: [f64; 2],
    /// Height of each node, x fastest; absent outside the part.
    heights_mm: Vec<Option<f32>>,
    /// Height of the scallops at each node, in nanometres; empty if no path can be planned.
    scallops_nm: Vec<Option<f32>>,
    /// Targets of the probe in their order: every `every_target`-th one.
    targets_mm: Vec<[f32; 3]>,
    every_target: usize,
    /// Centre of the wheel along the tracks, x and y: every `every_track`-th track.
    tracks_mm: Vec<Vec<[f32; 2]>>,
    every_track: usize,
}

impl Shape {
    fn new(task: &Task, path: Option<&ToolPath>) -> Self {
        let surface = SampledHeights::new(&task.nominal);
        let scallop = |place: [f64; 2]| path.map(|path| (1e6 * path.scallop_height_at(place)) as f32);
        let places = || (0..surface.rows).flat_map(|row| (0..surface.columns).map(move |column| [column, row]));
        let scallops_nm = match path {
            Some(_) => places().zip(&surface.heights_mm).map(|(at, z)| z.and_then(|_| scallop(surface.place(at)))),
            None => return Self::without_path(task, surface),
        };
        let scallops_nm = scallops_nm.collect();
        let (tracks_mm, every_track) = path.map_or((Vec::new(), 1), tracks);
        Self { scallops_nm, tracks_mm, every_track, ..Self::without_path(task, surface) }
    }

    fn without_path(task: &Task, surface: SampledHeights) -> Self {
        let every_target = task.targets.len().div_ceil(MAX_TARGETS).max(1);
        let targets = task.targets.iter().step_by(every_target).map(|target| target.point);
        Self {
            columns: surface.columns,
            rows: surface.rows,
            first_mm: surface.first_mm,
            spacing_mm: surface.spacing_mm,
            scallops_nm: Vec::new(),
            targets_mm: targets.map(|p| [p.x as f32, p.y as f32, p.z as f32]).collect(),
            every_target,
            tracks_mm: Vec::new(),
            every_track: 1,
            heights_mm: surface.heights_mm,
        }
    }
}

/// Heights of a nominal surface over a regular grid.
struct SampledHeights {
    columns: usize,
    rows: usize,
    first_mm: [f64; 2],
    spacing_mm: [f64; 2],
    heights_mm: Vec<Option<f32>>,
}

impl SampledHeights {
    /// Samples the surface from its formula or its points. A surface that is not one height over x and y is shown by its
    /// highest points.
    fn new(nominal: &Nominal) -> Self {
        match Programs::surface_and_outline(nominal) {
            Ok((field, outline)) => {
                let height = |[x, y]: [f64; 2]| outline.contains(x, y).then(|| field.at([x, y]).value as f32);
                Self::sampled(outline.bounds(), MAX_NODES, height)
            }
            Err(_) => Self::of_points(nominal),
        }
    }

    fn sampled([low, high]: [[f64; 2]; 2], most: usize, height: impl Fn([f64; 2]) -> Option<f32>) -> Self {
        let size = [high[0] - low[0], high[1] - low[1]];
        let long = size[0].max(size[1]).max(f64::MIN_POSITIVE);
        let [columns, rows] = size.map(|side| ((most as f64 - 1.0) * side / long).round().max(1.0) as usize + 1);
        let spacing_mm = [size[0] / (columns - 1) as f64, size[1] / (rows - 1) as f64];
        let mut grid = Self { columns, rows, first_mm: low, spacing_mm, heights_mm: Vec::new() };
        grid.heights_mm = (0..rows * columns).map(|k| height(grid.place([k % columns, k / columns]))).collect();
        grid
    }

    fn of_points(nominal: &Nominal) -> Self {
        let bounds = nominal.points().fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], p| {
            [[low[0].min(p.x), low[1].min(p.y)], [high[0].max(p.x), high[1].max(p.y)]]
        });
        // Half as many nodes along a side as points, so that few nodes have none.
        let most = MAX_NODES.min((0.5 * (nominal.len() as f64).sqrt()) as usize).max(2);
        let mut grid = Self::sampled(bounds, most, |_| None);
        for p in nominal.points() {
            let node = |k: usize| ((p[k] - grid.first_mm[k]) / grid.spacing_mm[k]).round().max(0.0) as usize;
            let at = node(1).min(grid.rows - 1) * grid.columns + node(0).min(grid.columns - 1);
            let height = grid.heights_mm[at].get_or_insert(p.z as f32);
            *height = height.max(p.z as f32);
        }
        grid
    }

    fn place(&self, [column, row]: [usize; 2]) -> [f64; 2] {
        let along = |k: usize, index: usize| self.first_mm[k] + index as f64 * self.spacing_mm[k];
        [along(0, column), along(1, row)]
    }
}

/// Returns tracks of `path`, and the step between two of them. Each track is the centre of the wheel at its corners.
fn tracks(path: &ToolPath) -> (Vec<Vec<[f32; 2]>>, usize) {
    let corners = path_picture(path);
    let all: Vec<&[[f64; 3]]> = corners.split(|corner| corner[0].is_nan()).filter(|track| track.len() > 1).collect();
    let every = all.len().div_ceil(MAX_TRACKS).max(1);
    let kept: Vec<_> = all.into_iter().step_by(every).collect();
    let points: usize = kept.iter().map(|track| track.len()).sum();
    let thin = points.div_ceil(MAX_TRACK_POINTS).max(1);
    let line = |track: &[[f64; 3]]| {
        let last = track.len() - 1;
        let corners = track.iter().enumerate().filter(|(k, _)| k % thin == 0 || *k == last);
        corners.map(|(_, [x, y, _])| [*x as f32, *y as f32]).collect()
    };
    (kept.into_iter().map(line).collect(), every)
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind::geometry::Point;
    use regrind::surface::PlaneProjection;

    #[test]
    fn surface_is_sampled_over_its_longer_side() {
        let points = (0..21).flat_map(|y| (0..41).map(move |x| Point::new(f64::from(x), f64::from(y), f64::from(x))));
        let nominal = Nominal::from_points(points.collect(), PlaneProjection::Xy).unwrap();
        let heights = SampledHeights::new(&nominal);
        assert_eq!((heights.columns, heights.rows), (MAX_NODES, MAX_NODES / 2 + 1));
        let at = |column: usize, row: usize| heights.heights_mm[row * heights.columns + column];
        assert!((at(48, 24).unwrap() - 20.0).abs() < 1e-4, "{:?}", at(48, 24));
        assert_eq!(heights.place([MAX_NODES - 1, MAX_NODES / 2]), [40.0, 20.0]);
    }

    #[test]
    fn scattered_points_give_highest_of_each_node() {
        let places = (0..9).map(|k| [5.0 * f64::from(k % 3), 5.0 * f64::from(k / 3)]);
        let points = places.map(|[x, y]| Point::new(x, y, 0.1 * x + y)).chain([Point::new(9.5, 9.5, 20.0)]).collect();
        let heights = SampledHeights::of_points(&Nominal::from_points(points, PlaneProjection::Xy).unwrap());
        assert_eq!((heights.columns, heights.rows), (2, 2));
        assert_eq!(heights.heights_mm, [0.0, 1.0, 10.0, 20.0].map(Some));
    }
}
