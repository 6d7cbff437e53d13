//! Parts of every shape, each with an expectation of its own.

use crate::common::{RADIUS_MM, centres, placed, points, pose};
use regrind_core::geometry::{Point, Pose, Vector};
use regrind_core::registration::{
    Method, ProbeSide, Registration, RegistrationError, RegistrationOptions, Start, register,
};
use regrind_core::surface::{
    DefinedSurface, FacetIndex, Nominal, NominalKind, OffsetSurface, PlaneProjection, Side, SurfaceError,
};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise};
use regrind_sim::shape::{Biconic, OffAxisAsphere, Shape, Sphere, Wave};

fn gridded(shape: &dyn Shape, size_mm: [f64; 2], nodes: [usize; 2]) -> Nominal {
    Nominal::from_points(points(&shape.grid(size_mm[0], size_mm[1], nodes[0], nodes[1])), PlaneProjection::Auto)
        .unwrap()
}

/// Centres over a rectangle, placed and noisy.
fn measured(shape: &dyn Shape, half: [f64; 2], counts: [usize; 2], placement: &Placement, noise_mm: f64) -> Vec<Point> {
    let mut all = placed(placement, &centres(shape, &FormError::none(), [[-half[0], -half[1]], half], counts));
    add_noise(&mut regrind_sim::rng(4), &mut all, noise_mm);
    points(&all)
}

/// How far the found pose carries points of the surface off the surface where the truth has it: what a map would see.
///
/// A part that can be turned into itself may be found turned; that is no error.
fn normal_error_mm(found: &Pose, truth: &Pose, shape: &dyn Shape, half: [f64; 2]) -> f64 {
    let at = |k: i32, h: f64| h * f64::from(k) / 4.0;
    (-4..=4)
        .flat_map(|j| (-4..=4).map(move |i| (at(i, half[0]), at(j, half[1]))))
        .map(|(x, y)| {
            let q = truth.inverse().transform_point(&found.transform_point(&Point::from(shape.point(x, y))));
            (q.z - shape.height(q.x, q.y)).abs() * shape.normal(q.x, q.y)[2]
        })
        .fold(0.0, f64::max)
}

fn from_identity(probe_radius_mm: f64) -> RegistrationOptions {
    RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(probe_radius_mm) }
}

fn weak_direction_words(found: &Registration) -> String {
    found.quality.weak_directions.iter().map(|w| w.description.as_str()).collect::<Vec<_>>().join("; ")
}

#[test]
fn register_off_axis_asphere() {
    let shape = OffAxisAsphere { radius_mm: 120.0, conic: -1.2, fourth: 3e-8, shift_mm: 70.0 };
    let nominal = gridded(&shape, [80.0, 60.0], [401, 301]);
    let placement = Placement::new([30.0, -80.0, 12.0], [15.0, -100.0, 60.0]);
    let cloud = measured(&shape, [39.0, 29.0], [60, 45], &placement, 3e-4);
    let found = register(&nominal, &cloud, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let error = normal_error_mm(&found.cmm_from_model, &pose(&placement), &shape, [39.0, 29.0]);
    assert!(error < 2e-4, "{error} mm");
    // The parent is a surface of revolution about the line x = -70.
    let said = weak_direction_words(&found);
    let axis = ["rotation about z", "(-70.0"];
    let is_parent = |words: &str| axis.iter().all(|piece| words.contains(piece));
    assert!(found.quality.weak_directions.iter().any(|w| w.is_undetermined && is_parent(&w.description)), "{said}");
    assert!((found.quality.rms_mm / 3e-4 - 1.0).abs() < 0.05, "{}", found.quality.rms_mm);
}

#[test]
fn biconic_reports_alternative_pose() {
    let shape = Biconic { radius_mm: [90.0, -140.0], conic: [-0.7, 1.2] };
    let nominal = gridded(&shape, [60.0, 60.0], [301, 301]);
    let placement = Placement::new([-5.0, 8.0, 100.0], [3.0, 170.0, 40.0]);
    let cloud = measured(&shape, [29.0, 29.0], [45, 45], &placement, 3e-4);
    let found = register(&nominal, &cloud, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    // Half a turn about z carries the surface into itself: either pose is right, and the other one is named.
    let half_turn = Pose::exp(&regrind_core::geometry::Twist::new(0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI));
    let truths = [pose(&placement), pose(&placement) * half_turn];
    let error = |p: &Pose| {
        truths.map(|t| normal_error_mm(p, &t, &shape, [29.0, 29.0])).into_iter().fold(f64::INFINITY, f64::min)
    };
    assert!(error(&found.cmm_from_model) < 2e-4);
    assert_eq!(found.quality.alternatives.len(), 1);
    assert!(error(&found.quality.alternatives[0].0) < 2e-3);
    assert!((found.cmm_from_model.inverse() * found.quality.alternatives[0].0).angle_rad() > 3.0);
}

#[test]
fn shallow_wave_reports_weak_directions() {
    let shape = Wave { height_mm: 0.01 };
    let nominal = gridded(&shape, [100.0, 80.0], [401, 321]);
    let placement = Placement::new([0.4, -0.3, 0.8], [0.02, -0.03, 0.2]);
    let options = from_identity(RADIUS_MM);
    let found = register(&nominal, &measured(&shape, [48.0, 38.0], [50, 40], &placement, 3e-4), &options).unwrap();
    let error = normal_error_mm(&found.cmm_from_model, &pose(&placement), &shape, [48.0, 38.0]);
    assert!(error < 1e-4, "{error}");
    let said = weak_direction_words(&found);
    let weak = &found.quality.weak_directions;
    assert!(weak.iter().any(|w| w.description.contains("x and y position") && w.sigma_mm.is_some()), "{said}");
    assert!(weak.iter().all(|w| !w.is_undetermined), "{said}");
    // What is said of the weak directions is true of them.
    let off = (pose(&placement).inverse() * found.cmm_from_model).log();
    for k in [0, 1] {
        assert!(off[k].abs() < 4.0 * found.quality.covariance[(k, k)].sqrt(), "axis {k}: {}", off[k]);
    }
}

#[test]
fn sphere_cap_locks_rotations() {
    let shape = Sphere { radius_mm: -60.0 };
    let nominal = gridded(&shape, [50.0, 50.0], [201, 201]);
    let placement = Placement::new([1.0, 2.0, -1.5], [0.0, 0.0, 0.0]);
    let options = from_identity(RADIUS_MM);
    let found = register(&nominal, &measured(&shape, [22.0, 22.0], [40, 40], &placement, 3e-4), &options).unwrap();
    let said = weak_direction_words(&found);
    assert!(said.contains("every rotation about (") && said.contains("-60.0"), "{said}");
    assert!(found.quality.weak_directions[0].is_undetermined);
    // The centre is where it should be, to the scatter of 1,600 points; no rotation was made up.
    let centre = Point::new(0.0, 0.0, -60.0);
    assert!((found.cmm_from_model.transform_point(&centre) - pose(&placement).transform_point(&centre)).norm() < 1e-3);
    assert!(found.cmm_from_model.angle_rad() < 0.2);
    assert!((found.quality.rms_mm / 3e-4 - 1.0).abs() < 0.05);
}

#[test]
fn scattered_sphere_locks_rotations() {
    let nominal = Nominal::from_points(polar_cap(60.0, 6000, 25.0, 0.0), PlaneProjection::Auto).unwrap();
    assert_eq!(nominal.kind(), NominalKind::Scattered { projection: PlaneProjection::Xy });
    let centres: Vec<Point> = polar_cap(61.5, 900, 22.0, 0.3);
    let options = from_identity(RADIUS_MM);
    let found = register(&nominal, &centres, &options).unwrap();
    assert!(weak_direction_words(&found).contains("every rotation about ("), "{}", weak_direction_words(&found));
}

#[test]
fn plane_and_cylinder_lock_free_motions() {
    let plane: Vec<Point> = (0..900).map(|k| Point::new(f64::from(k % 30), f64::from(k / 30), 0.0)).collect();
    let nominal = Nominal::from_points(plane, PlaneProjection::Auto).unwrap();
    let tilted = Placement::new([0.0, 0.0, 0.3], [1.0, -2.0, 0.0]);
    let on_plane: Vec<_> = (0..400).map(|k| [4.0 + f64::from(k % 20), 4.0 + f64::from(k / 20), RADIUS_MM]).collect();
    let options = from_identity(RADIUS_MM);
    let found = register(&nominal, &points(&placed(&tilted, &on_plane)), &options).unwrap();
    let said = weak_direction_words(&found);
    assert!(said.contains("shift along") && said.contains("rotation about z"), "{said}");
    assert!(found.quality.pv_mm < 1e-9);

    let gutter = |r: f64| move |x: f64, t: f64| Point::new(x, r * t.sin(), r * (1.0 - t.cos()) + (20.0 - r));
    let at = |k: i32, n: i32, low: f64, high: f64| low + (high - low) * f64::from(k) / f64::from(n - 1);
    let nominal = Nominal::from_parameter_grid(
        41,
        61,
        (0..61)
            .flat_map(|j| (0..41).map(move |i| gutter(20.0)(at(i, 41, -20.0, 20.0), at(j, 61, -0.8, 0.8))))
            .collect(),
    )
    .unwrap();
    let on_offset: Vec<_> = (0..20)
        .flat_map(|j| (0..20).map(move |i| gutter(18.5)(at(i, 20, -15.0, 15.0), at(j, 20, -0.6, 0.6)).into()))
        .collect();
    let found = register(&nominal, &points(&placed(&tilted, &on_offset)), &options).unwrap();
    let said = weak_direction_words(&found);
    assert!(said.contains("shift along x") && said.contains("rotation about x"), "{said}");
    assert!(found.quality.pv_mm < 1e-5, "{}", found.quality.pv_mm);
}

/// Points on a sphere about (0, 0, -r0) that stand evenly, to a polar angle.
fn polar_cap(radius: f64, count: usize, polar_deg: f64, phase: f64) -> Vec<Point> {
    let lowest = polar_deg.to_radians().cos();
    (0..count)
        .map(|k| {
            let c = 1.0 - (1.0 - lowest) * (k as f64 + 0.5) / count as f64;
            let (s, phi) = ((1.0 - c * c).sqrt(), 2.399_963_229_728_653 * k as f64 + phase);
            Point::new(radius * s * phi.cos(), radius * s * phi.sin(), radius * c)
        })
        .collect()
}

/// A bumpy hyperparameters-hemisphere: radius and normal in closed form over the direction.
fn bumpy(direction: &Vector) -> (Point, Vector) {
    // The level set F(p) = |p| - r(p/|p|), r = 20 + 0.8 (u.x^2 - 0.7 u.y u.z + 0.5 u.x u.z + 0.4 u.y), u on the unit
    // sphere.
    let u = direction.normalize();
    let radius = |u: &Vector| 20.0 + 0.8 * (u.x * u.x - 0.7 * u.y * u.z + 0.5 * u.x * u.z + 0.4 * u.y);
    let gradient = Vector::new(2.0 * u.x + 0.5 * u.z, -0.7 * u.z + 0.4, -0.7 * u.y + 0.5 * u.x) * 0.8;
    let r = radius(&u);
    let tangential = gradient - u * gradient.dot(&u);
    (Point::from(u * r), (u - tangential / r).normalize())
}

#[test]
fn register_hyper_hemisphere() {
    let nominal: Vec<Point> = polar_cap(1.0, 40_000, 120.0, 0.0).iter().map(|u| bumpy(&u.coords).0).collect();
    let nominal = Nominal::from_points(nominal, PlaneProjection::Auto).unwrap();
    assert_eq!(nominal.kind(), NominalKind::Scattered { projection: PlaneProjection::Spherical });
    let exact: Vec<[f64; 3]> = polar_cap(1.0, 3_000, 117.0, 1.0)
        .iter()
        .map(|u| {
            let (p, n) = bumpy(&u.coords);
            (p + n * RADIUS_MM).into()
        })
        .collect();
    let surface = OffsetSurface::new(&nominal, RADIUS_MM, Side::Normal).unwrap();
    let worst = exact
        .iter()
        .map(|c| surface.project(&Point::from(*c), FacetIndex::UNKNOWN).distance_mm.abs())
        .fold(0.0, f64::max);
    assert!(worst < 2e-6, "{worst} mm");
    let placement = Placement::new([100.0, -40.0, 7.0], [30.0, 160.0, -70.0]);
    let found = register(&nominal, &points(&placed(&placement, &exact)), &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let off = (pose(&placement).inverse() * found.cmm_from_model).log();
    assert!(off.fixed_rows::<3>(0).norm() < 1e-6 && off.fixed_rows::<3>(3).norm() < 1e-6, "{off}");
    assert!(matches!(
        Nominal::from_points(polar_cap(20.0, 4000, 120.0, 0.0), PlaneProjection::Xy),
        Err(SurfaceError::NoProjection { .. })
    ));
}

#[test]
fn several_patches_are_one_surface() {
    // The free form cut in two with a little overlap.
    let shape = regrind_sim::shape::FreeForm::default();
    let part = |low: f64, high: f64| -> Nominal {
        let at = |k: usize, n: usize, a: f64, b: f64| a + (b - a) * k as f64 / (n - 1) as f64;
        let grid = (0..151).flat_map(|j| (0..141).map(move |i| (i, j)));
        let cloud = grid.map(|(i, j)| Point::from(shape.point(at(i, 141, low, high), at(j, 151, -31.0, 31.0))));
        Nominal::from_points(cloud.collect(), PlaneProjection::Auto).unwrap()
    };
    let nominal = Nominal::from_patches(vec![part(-51.0, 1.0), part(-1.0, 51.0)]).unwrap();
    let placement = Placement::new([10.0, 5.0, 3.0], [5.0, -5.0, 8.0]);
    let cloud = measured(&shape, [50.0, 30.0], [50, 30], &placement, 0.0);
    let found = register(&nominal, &cloud, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    assert_eq!(found.quality.inliers, 1500);
    assert!(normal_error_mm(&found.cmm_from_model, &pose(&placement), &shape, [50.0, 30.0]) < 1e-7);
}

#[test]
fn folding_offset_refused_with_radius() {
    let bowl = Sphere { radius_mm: 1.2 };
    let nominal = gridded(&bowl, [1.2, 1.2], [61, 61]);
    let cloud = measured(&Sphere { radius_mm: 40.0 }, [0.5, 0.5], [10, 10], &Placement::IDENTITY, 0.0);
    let mut options = RegistrationOptions { side: ProbeSide::Above, ..from_identity(0.3) };
    // A probe that fits is not refused for folding.
    assert!(!matches!(
        register(&nominal, &cloud, &options),
        Err(RegistrationError::Surface(SurfaceError::OffsetFolds { .. }))
    ));
    // A gutter of which a probe of 1.45 mm touches both walls at once: measured with a smaller one, registered with
    // that one.
    for wide in [[4.0, 20.0], [2.9, 30.0]] {
        let gutter = Biconic { radius_mm: [1.4, 90.0], conic: [-1.0, -1.0] };
        let nominal = gridded(&gutter, wide, [81, 81]);
        options.probe_radius_mm = 1.45;
        options.rms_limit_mm = Some(10.0);
        let error = register(&nominal, &cloud_of(&gutter, wide), &options).unwrap_err();
        let RegistrationError::Surface(SurfaceError::OffsetFolds { concave_radius_mm, at, .. }) = error else {
            panic!("{error}")
        };
        // The paraboloid is most concave along its middle line, x = 0.
        assert!((concave_radius_mm - 1.4).abs() < 0.02 && at[0].abs() < 0.2, "{concave_radius_mm} at {at:?}");
    }
}

fn cloud_of(shape: &dyn Shape, size: [f64; 2]) -> Vec<Point> {
    points(&shape.grid(size[0] * 0.9, size[1] * 0.9, 12, 12))
}

#[test]
fn formula_and_points_agree() {
    let text = r#"
        [surface]
        kind = "off-axis"
        distance_mm = 70.0
        azimuth_deg = 0.0
        frame = "shifted"
        [surface.parent]
        kind = "asphere"
        radius_mm = 120.0
        conic = -1.2
        coefficients = { A4 = 3.0e-8 }
        [aperture]
        kind = "ellipse"
        semi_axes_mm = [38.0, 28.0]
        [sampling]
        accuracy_nm = 0.1
    "#;
    let defined = DefinedSurface::from_toml(text).unwrap();
    let s = defined.sample(defined.spacing_mm().unwrap()).unwrap();
    let analytic = Nominal::from_grid_with_normals(s.columns, s.rows, s.points, s.normals)
        .unwrap()
        .with_outline(defined.aperture().clone());
    let shape = OffAxisAsphere { radius_mm: 120.0, conic: -1.2, fourth: 3e-8, shift_mm: 70.0 };
    // The section's own origin may differ from the simulator's by the parent's height at the centre.
    let lift = shape.height(0.0, 0.0) - defined.formula().sag(0.0, 0.0).unwrap();
    let placement = Placement::new([10.0, 5.0, 3.0], [5.0, -5.0, 8.0]);
    let form = FormError::new(2, 30.0, 6.657e-3, 80.0, 60.0);
    let mut cloud = centres(&shape, &form, [[-37.0, -27.0], [37.0, 27.0]], [80, 60]);
    cloud.retain(|c| (c[0] / 36.0).hypot(c[1] / 26.0) < 0.97);
    let cloud = points(&placed(&placement, &cloud));
    let from_formula = register(&analytic, &cloud, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let from_points =
        register(&gridded(&shape, [80.0, 60.0], [801, 601]), &cloud, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let lifted = Pose { translation_mm: Vector::new(0.0, 0.0, lift), ..Pose::identity() };
    // Both hold the rotation about the parent's axis where their own search left it, so the surfaces are compared.
    let between =
        normal_error_mm(&(from_formula.cmm_from_model), &(from_points.cmm_from_model * lifted), &shape, [27.0, 20.0]);
    assert!(between < 1e-7, "{between} mm");
    assert!((from_formula.quality.rms_mm - from_points.quality.rms_mm).abs() < 1e-9);
    assert_eq!(from_formula.quality.inliers, cloud.len());
}

#[test]
fn robust_losses_from_start_pose() {
    let shape = regrind_sim::shape::FreeForm::default();
    let nominal = crate::common::free_form(301, 181);
    let placement = Placement::new([0.3, -0.2, 0.25], [0.2, 0.1, -0.3]);
    let cloud = measured(&shape, [50.0, 30.0], [50, 30], &placement, 3e-4);
    for loss in [regrind_core::registration::Loss::Huber, regrind_core::registration::Loss::Tukey] {
        let options =
            RegistrationOptions { loss, start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(RADIUS_MM) };
        let found = register(&nominal, &cloud, &options).unwrap();
        let error = normal_error_mm(&found.cmm_from_model, &pose(&placement), &shape, [50.0, 30.0]);
        assert!(error < 1e-4, "{loss:?}: {error} mm");
        assert!(found.trace.iter().all(|turn| turn.objective_mm2.is_finite()), "{loss:?}");
    }
}

#[test]
fn subtracted_radius_errs_by_micrometres() {
    let shape = regrind_sim::shape::FreeForm::default();
    let nominal = crate::common::free_form(451, 251);
    let placement = Placement::new([0.1, -0.2, 0.15], [0.1, 0.05, -0.1]);
    let form = FormError::new(8, 30.0, 6.657e-3, 102.0, 62.0);
    let cloud = points(&placed(&placement, &centres(&shape, &form, [[-50.0, -30.0], [50.0, 30.0]], [90, 60])));
    let offset = register(&nominal, &cloud, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    // Fig. 12b: the facet is looked up below the centre.
    let options = RegistrationOptions { method: Method::SubtractRadius, ..from_identity(RADIUS_MM) };
    let subtracted = register(&nominal, &cloud, &options).unwrap();
    let (low, high) = subtracted
        .deviations
        .iter()
        .zip(&offset.deviations)
        .map(|(s, o)| s.deviation_mm - o.deviation_mm)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), e| (l.min(e), h.max(e)));
    assert!(high - low > 1e-3, "PV of the difference {} mm", high - low);
}

#[test]
fn kinds_have_recorded_names() {
    let scattered = |projection| NominalKind::Scattered { projection };
    for (kind, name) in [
        (NominalKind::Grid { columns: 60, rows: 30 }, "Grid { columns: 60, rows: 30 }"),
        (scattered(PlaneProjection::Auto), "Scattered { projection: Auto }"),
        (scattered(PlaneProjection::Xy), "Scattered { projection: Xy }"),
        (scattered(PlaneProjection::BestFit), "Scattered { projection: BestFit }"),
        (scattered(PlaneProjection::Spherical), "Scattered { projection: Spherical }"),
        (NominalKind::Mesh, "Mesh"),
        (NominalKind::Patches { count: 3 }, "Patches { count: 3 }"),
    ] {
        assert_eq!(kind.to_string(), name);
    }
}
