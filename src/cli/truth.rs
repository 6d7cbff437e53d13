//! Truth of a simulated cell: the table `[simulation]` of a recipe, completed from the nominal surface of the part.

use std::sync::Arc;

use regrind::document::Problems;
use regrind::geometry::{Aperture, Point};
use regrind::recipe::Recipe;
use regrind::surface::Nominal;
use regrind_sim::aperture::Aperture as TrueAperture;
use regrind_sim::part::ShapeSpec;
use regrind_sim::spec::WorldSpec;

/// Largest distance of the true shape from the nominal surface, in mm. Beyond it, no probe finds the surface where the
/// plan expects it, or the part is never accepted.
const MAX_DIFFERENCE_MM: f64 = 1e-3;
/// Largest share of the nominal points that may be outside the true outline.
const MAX_SHARE_OUTSIDE: f64 = 0.02;
/// Number of nominal points that are compared with the truth.
const COMPARED: usize = 2000;
/// Largest stock of a blank, in micrometres, and its largest share of the removal budget, if the recipe states none.
const STOCK_UM: f64 = 200.0;
const STOCK_SHARE: f64 = 0.5;
/// Largest form error of a blank, as a share of its stock, if the recipe states none.
const FORM_ERROR_SHARE: f64 = 0.1;

/// Returns the properties of the simulated part and machines. They are those of the table `[simulation]` of `recipe`.
/// The table can be missing. Where it states no shape, outline, stock or form error of the part, the true shape is the
/// surface `nominal` itself, with its outline, and the blank has as much stock as the removal budget allows. If `seed`
/// is given, it replaces the seed of the random numbers.
///
/// # Errors
/// Returns a problem with the position of its key if the table is not valid, or if the stated truth is another part
/// than the nominal surface.
pub(super) fn world_spec(recipe: &Recipe, nominal: &Nominal, seed: Option<u64>) -> Result<WorldSpec, Problems> {
    let table = recipe.simulation.clone().unwrap_or_default();
    let states = |key: &str| table.get("part").and_then(|part| part.get(key)).is_some();
    let remedy = "correct the value, or remove the key: every key has a default";
    let mut spec: WorldSpec = toml::Value::Table(table.clone())
        .try_into()
        .map_err(|error: toml::de::Error| recipe.problem("simulation", error.message().trim(), "", remedy))?;
    spec.seed = seed.unwrap_or(spec.seed);
    let is_stated = states("shape") && !matches!(spec.part.shape, ShapeSpec::Nominal { .. });
    if !is_stated {
        let points: Vec<_> = nominal.points().map(|point| [point.x, point.y, point.z]).collect();
        spec.part.shape = ShapeSpec::Nominal { points: Arc::from(points) };
    }
    if !states("aperture") {
        spec.part.aperture = outline(nominal);
    }
    if !states("stock_um") {
        let budget_um = recipe.compensation.removal_budget_um.0;
        spec.part.stock_um = STOCK_UM.min(STOCK_SHARE * budget_um);
        if !states("form_error_um") {
            spec.part.form_error_um = FORM_ERROR_SHARE * spec.part.stock_um;
        }
    }
    spec.check().map_err(|error| {
        let (key, allowed) = (format!("simulation.{}", error.key), format!("allowed is {}", error.limit));
        recipe.problem(&key, &format!("is {}", error.value), &allowed, remedy)
    })?;
    compare(recipe, nominal, &spec, is_stated)?;
    Ok(spec)
}

/// Returns the outline of the nominal surface for the simulator: the stated one, or the convex hull of the points.
fn outline(nominal: &Nominal) -> TrueAperture {
    match nominal.outline() {
        Some(Aperture::Rectangle { centre_mm, width_mm, height_mm }) => {
            TrueAperture::Rectangle { half_x_mm: 0.5 * width_mm, half_y_mm: 0.5 * height_mm, centre_mm: *centre_mm }
        }
        Some(Aperture::Circle { centre_mm, radius_mm }) => {
            TrueAperture::Circle { radius_mm: *radius_mm, centre_mm: *centre_mm }
        }
        Some(Aperture::Ellipse { centre_mm, semi_axes_mm }) => {
            TrueAperture::Ellipse { semi_axes_mm: *semi_axes_mm, centre_mm: *centre_mm }
        }
        Some(Aperture::Annulus { centre_mm, inner_radius_mm, outer_radius_mm }) => TrueAperture::Annulus {
            inner_radius_mm: *inner_radius_mm,
            outer_radius_mm: *outer_radius_mm,
            centre_mm: *centre_mm,
        },
        Some(Aperture::Polygon { corners_mm }) => TrueAperture::Polygon { corners_mm: corners_mm.clone() },
        None => TrueAperture::convex_hull(nominal.points().map(|point| [point.x, point.y]).collect()),
    }
}

/// Compares the truth in `spec` with points of the nominal surface. `is_stated` is true if the recipe states the true
/// shape. Otherwise the shape is a fit through the points of the nominal surface, which can be too coarse for it.
///
/// # Errors
/// Returns a problem if the true outline leaves out a part of the nominal surface, or if the true shape differs from
/// it. Returns a problem if the recipe states that the shape is wrong, but no shape.
fn compare(recipe: &Recipe, nominal: &Nominal, spec: &WorldSpec, is_stated: bool) -> Result<(), Problems> {
    let is_on_part = |x: f64, y: f64| nominal.outline().is_none_or(|outline| outline.contains(x, y));
    let points: Vec<&Point> = nominal.points().filter(|point| is_on_part(point.x, point.y)).collect();
    let compared = points.iter().copied().step_by(points.len().div_ceil(COMPARED).max(1));
    let (inside, outside): (Vec<&Point>, Vec<&Point>) =
        compared.partition(|point| spec.part.aperture.contains(point.x, point.y));
    let count = inside.len() + outside.len();
    if outside.len() as f64 > MAX_SHARE_OUTSIDE * count as f64 {
        return Err(recipe.problem(
            "simulation.part.aperture",
            &format!("leaves out {} of {count} points of the nominal surface", outside.len()),
            &format!("at most {} % may be outside", 100.0 * MAX_SHARE_OUTSIDE),
            "remove the table: then the outline is that of the nominal surface",
        ));
    }
    match (spec.faults.wrong_shape, is_stated) {
        (true, true) => return Ok(()),
        (true, false) => {
            let remedy = "state the shape of the other part in simulation.part.shape, or remove the key";
            return Err(recipe.problem("simulation.faults.wrong_shape", "is true, but no shape is stated", "", remedy));
        }
        (false, _) => {}
    }
    let remedy = match is_stated {
        true => {
            "remove the table: then the true shape is the nominal surface; or correct the formula; or state \
             simulation.faults.wrong_shape = true, to try out another part"
        }
        false => {
            "the truth is a smooth fit through the nominal points: give points that are closer to each other and without \
             noise, or state the formula in simulation.part.shape"
        }
    };
    let shape = spec.part.shape.build();
    let difference_mm = |x: f64, y: f64, z: f64| {
        let [p, q] = shape.gradient(x, y);
        (shape.height(x, y) - z) / (1.0 + p * p + q * q).sqrt()
    };
    let differences = inside.iter().map(|p| (difference_mm(p.x, p.y, p.z), [p.x, p.y]));
    match differences.max_by(|a, b| a.0.abs().total_cmp(&b.0.abs())) {
        Some((by_mm, [x, y])) if by_mm.is_nan() || by_mm.abs() > MAX_DIFFERENCE_MM => Err(recipe.problem(
            "simulation.part.shape",
            &format!("is {:+.4} mm from the nominal surface at ({x:.2}, {y:.2}) mm", by_mm),
            &format!("it may differ by {} µm", 1e3 * MAX_DIFFERENCE_MM),
            remedy,
        )),
        _ => Ok(()),
    }
}
