//! Checks of a recipe against the limits of a cell.

use std::fmt::Write as _;

use super::error::SetupError;
use crate::config::CellConfig;
use crate::drive::ReferenceSphere;
use crate::geometry::Point;
use crate::measuring::Target;
use crate::recipe::Recipe;
use crate::surface::Nominal;

pub(super) fn check_limits(recipe: &Recipe, cell: &CellConfig, targets: &[Target]) -> Result<(), SetupError> {
    let limits = &cell.grinder.limits;
    let beyond = |key: &'static str, found: f64, least: f64, most: f64, limit: &'static str| {
        if (least..=most).contains(&found) {
            return Ok(());
        }
        let mut allowed = String::new();
        let _ = if least > 0.0 { write!(allowed, "{least} to {most}") } else { write!(allowed, "at most {most}") };
        let (recipe, cell) = (recipe.path().into(), cell.path().into());
        Err(SetupError::Limit { recipe, cell, key, found, allowed: allowed.into(), limit })
    };
    let [least, most] = limits.wheel_radius_mm;
    beyond("grinding.wheel.radius_mm", recipe.grinding.wheel.radius_mm(), least, most, "grinder.limits")?;
    let feed = recipe.grinding.feed_mm_min;
    beyond("grinding.feed_mm_min", feed, 0.0, limits.max_feed_mm_min, "grinder.limits.max_feed_mm_min")?;
    // Each value keeps its own unit in the message: micrometres in the recipe, millimetres in the cell file.
    let (depth_um, max_um) = (recipe.compensation.depth_of_cut_um.0, 1e3 * limits.max_depth_mm);
    beyond("compensation.depth_of_cut_um", depth_um, 0.0, max_um, "1000 times grinder.limits.max_depth_mm")?;
    if targets.is_empty() && !cell.cmm.link.wire.is_by_person() {
        return Err(SetupError::NeedsPlan { recipe: recipe.path().to_owned(), cell: cell.path().to_owned() });
    }
    let of_temperature = [
        ("part.expansion_um_m_k", recipe.part.expansion_um_m_k.is_some()),
        ("measure.temperature_c", recipe.measure.temperature_c.is_some()),
    ];
    // Checked here, because the first measurement comes after the first grinding.
    if let Some((key, _)) = of_temperature.into_iter().find(|(_, is_there)| *is_there)
        && !cell.cmm.link.wire.reports_temperature()
    {
        return Err(SetupError::NoTemperature { recipe: recipe.path().into(), cell: cell.path().into(), key });
    }
    check_travel(recipe, cell, targets)
}

fn check_travel(recipe: &Recipe, cell: &CellConfig, targets: &[Target]) -> Result<(), SetupError> {
    let Some(travel) = &cell.cmm.travel else { return Ok(()) };
    let reach = recipe.measure.probe_radius_mm + recipe.measure.approach_mm;
    let pose = &cell.cmm.fixture_cmm_from_model;
    let outside = |p: &Point| (0..3).any(|k| !(travel.min_mm[k]..=travel.max_mm[k]).contains(&p[k]));
    let found = targets
        .iter()
        .map(|t| pose.transform_point(&(t.point + reach * t.normal)))
        .enumerate()
        .find(|(_, p)| outside(p));
    match found {
        None => Ok(()),
        Some((k, at)) => Err(SetupError::Travel {
            recipe: recipe.path().into(),
            cell: cell.path().into(),
            number: k + 1,
            at: format!("{:.2}, {:.2}, {:.2}", at.x, at.y, at.z).into(),
            allowed: format!("{:?} to {:?}", travel.min_mm, travel.max_mm).into(),
        }),
    }
}

/// Checks that the probe has enough room between the reference sphere and the part in its fixture. The part is
/// approximated by the box around its nominal points. This box is aligned with the axes of the model frame and extended
/// without limit towards -z. The gap is the distance from the box to the surface of the sphere. It must be at least the
/// diameter of the probe plus the approach distance of the recipe.
///
/// # Errors
/// Returns an error if the gap is too small.
pub(super) fn check_sphere(
    recipe: &Recipe,
    cell: &CellConfig,
    nominal: &Nominal,
    sphere: &ReferenceSphere,
) -> Result<(), SetupError> {
    let centre = cell.cmm.fixture_cmm_from_model.inverse().transform_point(&sphere.centre);
    let mut nearest = Point::from([f64::INFINITY; 3]);
    let mut farthest = -nearest;
    for p in nominal.points() {
        (nearest, farthest) = (nearest.inf(p), farthest.sup(p));
    }
    let beside = |at: f64, low: f64, high: f64| (low - at).max(at - high).max(0.0);
    let [x, y] = [0, 1].map(|k| beside(centre[k], nearest[k], farthest[k]));
    let gap_mm = x.hypot(y).hypot((centre.z - farthest.z).max(0.0)) - sphere.radius_mm;
    // The stylus moves around the sphere with its ball.
    let needed_mm = 2.0 * recipe.measure.probe_radius_mm + recipe.measure.approach_mm;
    if gap_mm >= needed_mm {
        return Ok(());
    }
    let (recipe, cell) = (recipe.path().into(), cell.path().into());
    let at = format!("{:.1}, {:.1}, {:.1}", sphere.centre.x, sphere.centre.y, sphere.centre.z).into();
    Err(SetupError::SphereInPart { recipe, cell, at, gap_mm: gap_mm.max(0.0), needed_mm })
}
