//! Plans of runs for the page: the points of the CMM, the path of the wheel, and the equipment.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use regrind::compensation::path::{Move, ToolPath};
use regrind::config::CellConfig;
use regrind::formats::run_files::RunFile;
use regrind::recipe::{Recipe, WheelDimensions};
use regrind::record::begin_of;
use regrind::setup;
use regrind_page::{Equipment, RunPlan};

/// Angle, in rad, by which a path must bend before its picture gets a new point.
const BEND_RAD: f64 = 0.02;
/// Maximum number of points of the picture of a path.
const MAX_PATH_POINTS: usize = 40_000;

/// Number of runs whose plans are kept.
const KEPT_PLANS: usize = 4;

/// Points of the CMM and path of the wheel of one run.
struct Planned {
    points: Vec<[f64; 2]>,
    path: Option<Vec<[f64; 3]>>,
}

/// Plans of runs, computed again from the files in their folders. The last ones are kept, also those that cannot be
/// computed.
#[derive(Default)]
pub(super) struct RunPlans(Mutex<Vec<(PathBuf, Option<Arc<Planned>>)>>);

impl RunPlans {
    /// Returns the plan of a run. Other runs are not kept waiting while it is computed.
    fn of_run(&self, run: &Path) -> Option<Arc<Planned>> {
        let kept = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, planned)) = kept().iter().find(|(known, _)| known == run) {
            return planned.clone();
        }
        let planned = plan(run).map(Arc::new);
        let mut plans = kept();
        plans.insert(0, (run.to_owned(), planned.clone()));
        plans.truncate(KEPT_PLANS);
        planned
    }
}

impl RunPlan for RunPlans {
    fn points(&self, folder: &Path) -> Option<Vec<[f64; 2]>> {
        Some(self.of_run(folder)?.points.clone())
    }

    fn path(&self, folder: &Path) -> Option<Vec<[f64; 3]>> {
        self.of_run(folder)?.path.clone()
    }

    fn equipment(&self, folder: &Path) -> Option<Equipment> {
        let (recipe, cell) = recipe_and_cell(folder)?;
        Some(Equipment {
            calibration_due: [&cell.cmm.link, &cell.grinder.link].map(|link| link.calibration_due.clone()),
            probe_radius_mm: recipe.measure.probe_radius_mm,
            radius_tolerance_um: recipe.measure.qualify.then_some(recipe.measure.radius_tolerance_um.0),
            wheel_radius_mm: wheel_radius_mm(&recipe.grinding.wheel),
        })
    }
}

/// Reads the recipe and the cell file in the folder `run`. Returns `None` if one of them or the first record is missing
/// or invalid.
fn recipe_and_cell(run: &Path) -> Option<(Recipe, CellConfig)> {
    let begin = begin_of(run).ok()?;
    let start = begin.content.part()?;
    let from = PathBuf::from(start.working_folder.as_ref()?);
    let text = |file: RunFile| std::fs::read_to_string(run.join(file.name())).ok();
    let recipe = Recipe::parse(&from.join(start.recipe.as_ref()?), &text(RunFile::Recipe)?).ok()?;
    let cell = CellConfig::parse(&from.join(start.cell.as_ref()?), &text(RunFile::Cell)?).ok()?;
    Some((recipe, cell))
}

/// Plans the run in the folder `run` again. Returns `None` if its files are missing or invalid.
fn plan(run: &Path) -> Option<Planned> {
    let (recipe, cell) = recipe_and_cell(run)?;
    let (task, _) = setup::prepare(&recipe, &cell).ok()?;
    let path = task.first_path().ok().flatten().map(|(path, _)| path_picture(&path));
    let points = task.targets.iter().map(|target| [target.point.x, target.point.y]).collect();
    Some(Planned { points, path })
}

/// Returns the radius of a wheel that is a ball; `None` for other shapes.
fn wheel_radius_mm(wheel: &WheelDimensions) -> Option<f64> {
    match wheel {
        WheelDimensions::Sphere { radius_mm } => Some(*radius_mm),
        _ => None,
    }
}

/// Returns the path of the wheel as a line for people: its corners, and the points at which it has bent by
/// [`BEND_RAD`]. Each point is x and y in mm and the share of the length at feed up to it. A point that is not finite
/// begins a new track.
pub(super) fn path_picture(path: &ToolPath) -> Vec<[f64; 3]> {
    let mut corners: Vec<[f64; 3]> = Vec::new();
    let (mut length_mm, mut last, mut heading) = (0.0, None::<[f64; 3]>, None::<f64>);
    for step in path.moves() {
        let (Move::Feed { to, .. } | Move::FeedTilted { to, .. }) = step else {
            // The wheel is in the air until the next point at feed.
            corners.extend(last.take());
            heading = None;
            continue;
        };
        let Some([x, y, _]) = last else {
            corners.extend([[f64::NAN; 3], [to.x, to.y, length_mm]]);
            last = Some([to.x, to.y, length_mm]);
            continue;
        };
        let [dx, dy] = [to.x - x, to.y - y];
        let way_mm = dx.hypot(dy);
        if way_mm > 0.0 {
            let new_heading = dy.atan2(dx);
            let begun = *heading.get_or_insert(new_heading);
            let bend = (new_heading - begun + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
            if (bend - std::f64::consts::PI).abs() > BEND_RAD {
                corners.extend(last);
                heading = Some(new_heading);
            }
        }
        length_mm += way_mm;
        last = Some([to.x, to.y, length_mm]);
    }
    corners.extend(last);
    corners.iter_mut().for_each(|corner| corner[2] /= length_mm.max(f64::MIN_POSITIVE));
    let every = corners.len().div_ceil(MAX_PATH_POINTS).max(1);
    let kept = corners.iter().enumerate().filter(|(k, corner)| k % every == 0 || corner[0].is_nan());
    kept.map(|(_, corner)| *corner).collect()
}
