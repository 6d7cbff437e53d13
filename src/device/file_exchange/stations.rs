//! Registration of several stations in one frame, each by the reference points that it sees.
//!
//! A rigid best fit registers a station to the nominal reference points. The residual of every reference point is
//! reported. A point with a residual above a limit is named. If two points seem exchanged, or one seems moved, the
//! message says so, because a person must look for that.

use super::ExchangeError;
use regrind_core::geometry::{Point, Pose, RigidFit, Vector, fit_rigid};
use regrind_formats::references::{Reference, References};

/// Maximum number of nominal points for which subsets are tried, if a station names none.
const MAX_NOMINAL: usize = 12;

/// Pose of a station.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedStation {
    /// Name in messages.
    pub station: String,
    /// Pose that transforms the frame of the station to the frame of the nominal reference points.
    pub cmm_from_station: Pose,
    /// Names of the fitted reference points with their residuals in mm: nominal minus seen.
    pub residuals: Vec<(String, Vector)>,
    /// Root mean square of the lengths of the residuals, in mm.
    pub rms_mm: f64,
    /// Nominal points that the station does not see.
    pub missing: Vec<String>,
    /// Points of the station that are not nominal; they are not fitted.
    pub extra: Vec<String>,
}

impl PlacedStation {
    /// Returns a text about the registration of this station. The text contains the rms residual and the residual of
    /// each fitted reference point, in mm. It also names the nominal points that the station has not measured, and the
    /// measured points that are not nominal.
    pub fn summary(&self) -> String {
        let each: Vec<String> = self.residuals.iter().map(|(name, r)| format!("{name} {:.3}", r.norm())).collect();
        let mut words = format!(
            "station {}: the residuals of the reference points are {:.3} mm rms (each point: {} mm)",
            self.station,
            self.rms_mm,
            each.join(", ")
        );
        for (what, names) in [("does not see", &self.missing), ("ignored, not nominal:", &self.extra)] {
            if !names.is_empty() {
                words += &format!("; {what} {}", names.join(", "));
            }
        }
        words
    }
}

/// Registers the frame of a station to the frame of the nominal reference points by a rigid best fit. `seen` are the
/// reference points that the station has measured. `station` is the name of the station in messages. Returns the pose
/// and the residuals.
///
/// The measured points are matched to the nominal points by one of these rules:
///
/// - By name, if at least three measured points have the name of a nominal point.
/// - By their order, if no measured point has a nominal name and there are as many points as in `nominal`.
/// - By the distances between the points, if no measured point has a nominal name and there are fewer points than in
///   `nominal`. Exactly one subset of `nominal`, in the order of `nominal`, must then fit.
///
/// # Errors
/// Returns an error if the points cannot be matched, for example because only one or two have a nominal name. Returns
/// an error too if the points determine no pose, or if a residual exceeds `limit_mm`.
pub fn place_station(
    station: &str,
    seen: &References,
    nominal: &References,
    limit_mm: f64,
) -> Result<PlacedStation, ExchangeError> {
    let matching = match_points(station, seen, nominal, limit_mm)?;
    let (from, to) = matching.points(seen, nominal);
    let fit = fit_rigid(&from, &to).map_err(|source| ExchangeError::Fit { station: station.to_owned(), source })?;
    let names: Vec<String> = matching.pairs.iter().map(|&(_, n)| nominal.name(n)).collect();
    let (worst, off_mm) = fit.max_residual();
    if off_mm > limit_mm {
        let (suspect, diagnosis) = diagnose(&from, &to, &names, limit_mm);
        let point = suspect.unwrap_or(worst);
        let off_mm = if suspect.is_some() { off_without(&from, &to, point).unwrap_or(off_mm) } else { off_mm };
        let (station, point) = (station.to_owned(), names[point].clone());
        return Err(ExchangeError::ReferenceOff { station, point, off_mm, limit_mm, diagnosis });
    }
    let unpaired =
        |count: usize, paired: &dyn Fn(usize) -> bool| (0..count).filter(|&k| !paired(k)).collect::<Vec<_>>();
    let missing = unpaired(nominal.points.len(), &|n| matching.pairs.iter().any(|p| p.1 == n));
    let extra = unpaired(seen.points.len(), &|s| matching.pairs.iter().any(|p| p.0 == s));
    Ok(PlacedStation {
        station: station.to_owned(),
        cmm_from_station: fit.pose,
        residuals: names.into_iter().zip(fit.residuals_mm).collect(),
        rms_mm: fit.rms_mm,
        missing: missing.into_iter().map(|n| nominal.name(n)).collect(),
        extra: extra.into_iter().map(|s| seen.name(s)).collect(),
    })
}

/// Assignment of seen points to nominal points.
struct Matching {
    /// Pairs of indices into the seen and the nominal points.
    pairs: Vec<(usize, usize)>,
}

impl Matching {
    fn points(&self, seen: &References, nominal: &References) -> (Vec<Point>, Vec<Point>) {
        self.pairs.iter().map(|&(s, n)| (seen.points[s].at, nominal.points[n].at)).unzip()
    }
}

fn match_points(
    station: &str,
    seen: &References,
    nominal: &References,
    limit_mm: f64,
) -> Result<Matching, ExchangeError> {
    let place = |point: &Reference| nominal.points.iter().position(|n| n.name.is_some() && n.name == point.name);
    let named: Vec<(usize, usize)> =
        seen.points.iter().enumerate().filter_map(|(s, point)| Some((s, place(point)?))).collect();
    if named.len() >= 3 {
        return Ok(Matching { pairs: named });
    }
    if !named.is_empty() {
        let missing = (0..nominal.points.len()).filter(|n| named.iter().all(|p| p.1 != *n)).map(|n| nominal.name(n));
        let extra = (0..seen.points.len()).filter(|s| named.iter().all(|p| p.0 != *s)).map(|s| seen.name(s));
        return Err(ExchangeError::ReferenceNames {
            station: station.to_owned(),
            missing: missing.collect::<Vec<_>>().join(", "),
            extra: extra.collect::<Vec<_>>().join(", "),
        });
    }
    let (have, want) = (seen.points.len(), nominal.points.len());
    let refuse = |reason| ExchangeError::ReferenceCount {
        station: station.to_owned(),
        seen: have,
        nominal: want,
        names: (0..want).map(|n| nominal.name(n)).collect::<Vec<_>>().join(", "),
        reason,
    };
    match have {
        _ if have == want => Ok(Matching { pairs: (0..have).map(|k| (k, k)).collect() }),
        _ if have > want => Err(refuse("Regrind cannot determine which points of the station are extra")),
        _ if have < 3 => Err(refuse("at least 3 are required")),
        _ if want > MAX_NOMINAL => Err(refuse("Regrind cannot determine which nominal points are missing")),
        _ => match_subset(seen, nominal, limit_mm).map_err(refuse),
    }
}

/// Finds the subset of the nominal points to which the points `seen` fit with residuals of at most `limit_mm`. The
/// points of the subset keep the order of `nominal`: the first point of `seen` belongs to the first point of the
/// subset.
///
/// # Errors
/// Returns a text if no subset fits, or if more than one fits.
fn match_subset(seen: &References, nominal: &References, limit_mm: f64) -> Result<Matching, &'static str> {
    let (have, want) = (seen.points.len(), nominal.points.len());
    let chosen = |mask: u32| (0..want).filter(|n| mask >> n & 1 == 1).enumerate().collect::<Vec<_>>();
    let fits = (0..1u32 << want).filter(|mask| mask.count_ones() as usize == have).filter_map(|mask| {
        let matching = Matching { pairs: chosen(mask) };
        let (from, to) = matching.points(seen, nominal);
        fit_rigid(&from, &to).ok().filter(|fit| fit.max_residual().1 <= limit_mm).map(|_| matching)
    });
    let mut fits: Vec<Matching> = fits.take(2).collect();
    match fits.len() {
        1 => Ok(fits.remove(0)),
        0 => Err("the distances between the points match no set of nominal points"),
        _ => Err("the distances between the points match more than one set of nominal points"),
    }
}

/// Looks for the reason why the points `from` of a station do not fit the nominal points `to`. Tests two causes: two
/// points are swapped, or a single point is wrong. The points fit if no residual exceeds `limit_mm`. `names` are the
/// names of the points for the text.
///
/// Returns the index of the suspected point and a text about the probable cause. If two points are swapped, the index
/// is that of the first one. The index is `None` if neither cause explains the misfit.
fn diagnose(from: &[Point], to: &[Point], names: &[String], limit_mm: f64) -> (Option<usize>, String) {
    let fits = |fit: Option<RigidFit>| fit.is_some_and(|fit| fit.max_residual().1 <= limit_mm);
    for a in 0..from.len() {
        for b in a + 1..from.len() {
            let mut exchanged = from.to_vec();
            exchanged.swap(a, b);
            if fits(fit_rigid(&exchanged, to).ok()) {
                let words =
                    format!("{} and {} are probably swapped: all points fit if both are exchanged", names[a], names[b]);
                return (Some(a), words);
            }
        }
    }
    // At least four points are needed: the three that remain still have residuals to judge. If several points qualify,
    // none is named.
    let alone: Vec<usize> = (0..from.len())
        .filter(|&k| from.len() > 3 && fits(fit_rigid(&without(from, k), &without(to, k)).ok()))
        .collect();
    match alone[..] {
        [k] => {
            let words = "without this point the others fit: measure this point again, or correct the nominal point";
            (Some(k), words.to_owned())
        }
        _ => (None, "no single point causes the deviation: check the point order and the nominal file".to_owned()),
    }
}

fn without(points: &[Point], index: usize) -> Vec<Point> {
    points.iter().enumerate().filter(|(k, _)| *k != index).map(|(_, p)| *p).collect()
}

/// Returns the distance, in mm, of the point `index` from its nominal position. All other points of `from` are first
/// fitted to their nominal points in `to`. Returns `None` if these other points determine no pose.
fn off_without(from: &[Point], to: &[Point], index: usize) -> Option<f64> {
    let fit = fit_rigid(&without(from, index), &without(to, index)).ok()?;
    Some((to[index] - fit.pose.transform_point(&from[index])).norm())
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_core::geometry::Twist;
    use std::path::PathBuf;

    const AT: [(&str, [f64; 3]); 5] = [
        ("a", [0.0, 0.0, 0.0]),
        ("b", [1000.0, 0.0, 10.0]),
        ("c", [30.0, 700.0, 0.0]),
        ("d", [900.0, 800.0, 300.0]),
        ("e", [500.0, 300.0, 900.0]),
    ];

    fn nominal(count: usize) -> References {
        let point = |(name, at): &(&str, [f64; 3])| Reference { name: Some((*name).into()), at: Point::from(*at) };
        References { path: PathBuf::from("nominal.yaml"), points: AT[..count].iter().map(point).collect() }
    }

    fn truth() -> Pose {
        Pose::exp(&Twist::new(20.0, -3000.0, 5.0, 0.1, -0.4, 2.0))
    }

    /// Returns the points that a station at the simulated pose sees, in the given order, with or without names.
    fn seen(order: &[usize], named: bool) -> References {
        let point = |&k: &usize| Reference {
            name: named.then(|| AT[k].0.into()),
            at: truth().inverse().transform_point(&Point::from(AT[k].1)),
        };
        References { path: PathBuf::from("ref_3.yaml"), points: order.iter().map(point).collect() }
    }

    fn is_planted(station: &PlacedStation) -> bool {
        (station.cmm_from_station.rotation - truth().rotation).amax() < 1e-12 && station.rms_mm < 1e-9
    }

    #[test]
    fn station_placed_by_order_or_distance() {
        let placed = place_station("3", &seen(&[0, 1, 2, 3], false), &nominal(4), 0.1).unwrap();
        assert!(is_planted(&placed) && placed.missing.is_empty() && placed.residuals.len() == 4);
        let placed = place_station("3", &seen(&[3, 0, 4, 1], true), &nominal(4), 0.1).unwrap();
        assert!(is_planted(&placed));
        assert!(placed.missing == ["c"] && placed.extra == ["e"]);
        let summary = placed.summary();
        assert!(["not see c", "not nominal: e"].iter().all(|piece| summary.contains(piece)), "{summary}");
        let placed = place_station("3", &seen(&[0, 2, 3, 4], false), &nominal(5), 0.1).unwrap();
        assert!(is_planted(&placed) && placed.missing == ["b"]);
    }

    #[test]
    fn station_names_swapped_or_moved_point() {
        let error = place_station("3", &seen(&[0, 2, 1, 3, 4], false), &nominal(5), 0.1).unwrap_err();
        assert!(
            matches!(&error, ExchangeError::ReferenceOff { station, point, diagnosis, .. }
                if station == "3" && point == "b" && diagnosis.contains("b and c")),
            "{error}"
        );
        let mut moved = seen(&[0, 1, 2, 3, 4], false);
        moved.points[3].at.x += 2.0;
        let error = place_station("3", &moved, &nominal(5), 0.1).unwrap_err();
        assert!(
            matches!(&error, ExchangeError::ReferenceOff { point, off_mm, limit_mm, diagnosis, .. }
                if point == "d" && (off_mm - 2.0).abs() < 5e-4 && *limit_mm == 0.1 && diagnosis.contains("without")),
            "{error}"
        );
        assert!(place_station("3", &moved, &nominal(5), 2.0).is_ok());
    }

    #[test]
    fn station_refuses_unmatched_points() {
        let cases = [
            (seen(&[0, 1, 2, 3, 4], false), 4, &["extra"][..]),
            (seen(&[0, 1], false), 4, &["3 are required"]),
            (seen(&[0, 4], true), 4, &["missing: b, c, d", "unknown: e"]),
            (seen(&[4, 0, 1], false), 4, &["distances", "no set"]),
        ];
        for (seen, count, pieces) in cases {
            let message = place_station("3", &seen, &nominal(count), 0.1).unwrap_err().to_string();
            assert!(pieces.iter().all(|piece| message.contains(piece)), "{message}");
        }
        let mut line = nominal(4);
        line.points.iter_mut().for_each(|p| (p.at.y, p.at.z) = (0.0, 0.0));
        let message = place_station("3", &seen(&[0, 1, 2, 3], true), &line, 0.1).unwrap_err().to_string();
        assert!(message.contains("on one line"), "{message}");
    }
}
