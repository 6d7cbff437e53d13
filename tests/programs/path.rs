//! Paths of the shipped recipes, with a correction whose slope matters.
#![allow(dead_code, reason = "not every test that includes this uses all of it")]

use std::path::Path;

use regrind::compensation::Correction;
use regrind::compensation::path::{PathOptions, Wheel};
use regrind::config::CellConfig;
use regrind::drive::Programs;
use regrind::geometry::{Grid, Vector};
use regrind::recipe::Recipe;
use regrind::setup;
use regrind_sim::shape::Shape;
use regrind_sim::spec::WorldSpec;

/// Part: the options of its programs, and its true target surface.
pub struct Part {
    pub programs: Programs,
    pub shape: Box<dyn Shape>,
    pub half_mm: [f64; 2],
}

/// Prepares a shipped recipe in the simulated cell.
pub fn part(name: &str) -> Part {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    prepared(&Recipe::read(&root.join(format!("recipes/{name}.toml"))).unwrap())
}

/// Returns the same part, measured and machined from below.
pub fn part_from_below(name: &str) -> Part {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let recipes = root.join("recipes");
    let text = std::fs::read_to_string(recipes.join(format!("{name}.toml"))).unwrap();
    let text = text.replace("file = \"", &format!("file = \"{}/", recipes.display()));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("below.toml");
    std::fs::write(&file, text.replace("side = \"above\"", "side = \"below\"")).unwrap();
    prepared(&Recipe::read(&file).unwrap())
}

fn prepared(recipe: &Recipe) -> Part {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let cell = CellConfig::read(&root.join("config/sim.toml")).unwrap();
    let spec: WorldSpec = recipe.simulation.clone().unwrap().try_into().unwrap();
    let (task, _) = setup::prepare(recipe, &cell).unwrap();
    Part { programs: task.programs.unwrap(), shape: spec.part.shape.build(), half_mm: spec.part.aperture.half_mm() }
}

/// Three wheels that fit the shipped parts.
pub fn wheels(steepest_rad: f64) -> [(&'static str, Wheel); 3] {
    [
        ("sphere", Wheel::Sphere { radius_mm: 12.5 }),
        ("torus", Wheel::Torus { ring_mm: 20.0, tube_mm: 5.0, spindle: Vector::y() }),
        ("cup", Wheel::tilted_cup(8.0, 2.0, steepest_rad + 0.1)),
    ]
}

/// Returns an error of 10 um over 10 mm, plus a small independent part across.
pub fn error_mm(x: f64, y: f64) -> f64 {
    0.005 * (0.3 * x + 0.4).sin() * (0.25 * y).cos() + 1e-4 * x
}

/// Returns the correction for a part, defined well beyond its edges.
pub fn correction(half_mm: [f64; 2]) -> Correction {
    let reach = half_mm.map(|h| h + 4.0);
    let corners = [[-reach[0], -reach[1]], reach];
    let grid = Grid::over(corners.into_iter(), 0.5).unwrap();
    let values_mm = (0..grid.len()).map(|k| grid.place_mm(k)).map(|[x, y]| error_mm(x, y)).collect();
    Correction { grid, values_mm, cycle: 2, level_mm: 0.02, parameters: None }
}

/// Returns a point of the target surface in closed form: the shape moved along its normals by level and correction.
pub fn truth(part: &Part, level_mm: f64, [x, y]: [f64; 2]) -> [f64; 3] {
    let (p, n) = (part.shape.point(x, y), part.shape.normal(x, y));
    let d = level_mm + error_mm(x, y);
    std::array::from_fn(|k| p[k] + d * n[k])
}

/// Returns the same for the lower side, which moves in the opposite direction.
pub fn truth_below(part: &Part, level_mm: f64, [x, y]: [f64; 2]) -> [f64; 3] {
    let (p, n) = (part.shape.point(x, y), part.shape.normal(x, y));
    let d = level_mm + error_mm(x, y);
    std::array::from_fn(|k| p[k] - d * n[k])
}

/// Options with another wheel and other tracks.
pub fn with(options: &PathOptions, wheel: Wheel, track_mm: f64) -> PathOptions {
    use regrind::compensation::path::TrackSpacing;
    PathOptions { wheel, spacing: TrackSpacing::Distance(track_mm), ..*options }
}

/// Move of a program: its end, and whether it is at feed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProgramStep {
    pub at: [f64; 3],
    pub feed: bool,
}

/// Reads a program of G0 and G1 with an independent reader: words and modal state.
pub fn read(text: &str) -> Vec<ProgramStep> {
    let (mut steps, mut at, mut feed) = (Vec::new(), [f64::NAN; 3], false);
    for line in text.lines().filter(|line| !line.starts_with('(')) {
        let mut moved = false;
        let letters: Vec<(usize, char)> = line.char_indices().filter(|(_, c)| c.is_ascii_alphabetic()).collect();
        for (k, &(begin, letter)) in letters.iter().enumerate() {
            let end = letters.get(k + 1).map_or(line.len(), |next| next.0);
            let value: f64 = line[begin + 1..end].trim().parse().unwrap();
            match letter {
                'X' | 'Y' | 'Z' => {
                    at[letter as usize - 'X' as usize] = value;
                    moved = true;
                }
                'G' if value < 2.0 => feed = value == 1.0,
                _ => {}
            }
        }
        if moved {
            steps.push(ProgramStep { at, feed });
        }
    }
    steps
}
