//! Tests of recipes and cell files: the shipped files are valid, each error is reported at its position, and no input
//! makes the reader panic.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use proptest::prelude::*;
use regrind::cell::{FirstStep, HoldOrStop};
use regrind::compensation::{FilterOrder, SplineSmoothness};
use regrind::config::CellConfig;
use regrind::device::{Coordinates, TcpWire, Wire, WordOrder};
use regrind::document::Problems;
use regrind::formats::read_points;
use regrind::geometry::{Point, Pose};
use regrind::measuring::Layout;
use regrind::recipe::{MeasuringPattern, Micrometres, NominalSource, Recipe, RegistrationStart, WheelDimensions};
use regrind::registration::{Coordinate, ProbeSide, Start};
use regrind::setup::SetupError;
use regrind::surface::DefinedSurface;
use serde_json::Value;

const RECIPE: &str = include_str!("../../recipes/freeform-mirror.toml");
const BICONIC: &str = include_str!("../../recipes/biconic.toml");
const SPIRAL: &str = include_str!("../../recipes/off-axis-asphere.toml");
const TELESCOPE: &str = include_str!("../../recipes/telescope-panel.toml");
const SIM: &str = include_str!("../../config/sim.toml");
const TILTING: &str = include_str!("../../config/tilting.toml");
const TCP: &str = include_str!("../../config/modbus-tcp.toml");
const RTU: &str = include_str!("../../config/serial-rtu.toml");
const FILES: &str = include_str!("../../config/laser-tracker.toml");

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn shipped(folder: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(root().join(folder)).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> = entries.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect();
    files.sort();
    files
}

fn recipe(text: &str) -> Result<Recipe, Problems> {
    Recipe::parse(&root().join("recipes/test.toml"), text)
}

fn cell(text: &str) -> Result<CellConfig, Problems> {
    CellConfig::parse(&root().join("config/test.toml"), text)
}

fn changed(text: &str, from: &str, to: &str) -> String {
    assert_eq!(text.matches(from).count(), 1, "`{from}` must stand once");
    text.replacen(from, to, 1)
}

fn place_of(text: &str, needle: &str) -> (usize, usize) {
    place_of_byte(text, text.find(needle).unwrap_or_else(|| panic!("`{needle}` must stand in the text")))
}

#[test]
fn shipped_recipes_and_cells_are_valid() {
    let (recipes, cells) = (shipped("recipes"), shipped("config"));
    assert!(recipes.len() >= 5 && cells.len() >= 4);
    for path in &recipes {
        let recipe = Recipe::read(path).unwrap_or_else(|problems| panic!("{problems}"));
        let text = fs::read_to_string(path).unwrap();
        assert_eq!((recipe.text(), recipe.path()), (text.as_str(), path.as_path()));
    }
    for path in &cells {
        CellConfig::read(path).unwrap_or_else(|problems| panic!("{problems}"));
    }
    let output = Command::new(env!("CARGO_BIN_EXE_regrind")).arg("check").args(&recipes).args(&cells).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(text.matches("a good recipe").count(), recipes.len());
    assert_eq!(text.matches("a good cell file").count(), cells.len());
}

#[test]
fn default_recipe_values() {
    let recipe = recipe(RECIPE).unwrap();
    assert_eq!(recipe.part.name, "free-form mirror");
    assert_eq!(recipe.measure.probe_radius_mm, 1.5);
    assert_eq!(recipe.pattern, MeasuringPattern::Generated(Layout::GridPoints([60, 30])));
    assert_eq!(recipe.measure.side, ProbeSide::Above);
    assert_eq!((recipe.acceptance.pv_um, recipe.acceptance.rms_um), (Some(Micrometres(7.0)), Some(Micrometres(1.0))));
    assert_eq!(recipe.registration.max_turn_deg, 5.0);
    assert!((recipe.compensation.removal_budget_um.mm() - 0.4).abs() < 1e-15);
    assert_eq!(recipe.grinding.wheel, WheelDimensions::Sphere { radius_mm: 12.5 });
    assert_eq!((recipe.cycle.on_stall, recipe.cycle.on_divergence), (HoldOrStop::Stop, HoldOrStop::Hold));
    let options = recipe.registration_options(Pose::identity());
    assert_eq!((options.probe_radius_mm, options.start, options.rms_limit_mm), (1.5, Start::Search, Some(0.1)));
    let NominalSource::Surface(surface) = &recipe.nominal else { panic!("a formula") };
    let steepest = (0..=40)
        .flat_map(|j| (0..=40).map(move |i| (2.55 * f64::from(i) - 51.0, 1.55 * f64::from(j) - 31.0)))
        .map(|(x, y)| surface.formula().sag_and_gradient(x, y).unwrap().1)
        .map(|[p, q]| p.hypot(q).atan().to_degrees())
        .fold(0.0, f64::max);
    assert!((29.0..31.0).contains(&steepest), "{steepest} degrees");
    let hash = recipe.source_sha256().iter().map(|b| format!("{b:02x}")).collect::<String>();
    let again = self::recipe(&RECIPE.replace("12.5", "12.6")).unwrap();
    assert_eq!(hash.len(), 64);
    assert_ne!(recipe.source_sha256(), again.source_sha256());
}

/// Checks that the decision never uses a lower probability than the accepted risk for chosen touches allows. The
/// probability as written in the file counts.
#[test]
fn decision_probability_from_accepted_risk() {
    let with = |measuring: &str| recipe(&changed(RECIPE, "[registration]", &format!("{measuring}\n\n[registration]")));
    let adaptive = |risk: f64| format!("[measuring]\nmode = \"adaptive\"\naccepted_risk = {risk}");
    assert_eq!(recipe(RECIPE).unwrap().required_probability(), 0.975);
    assert_eq!(with("[measuring]\nmode = \"fixed\"").unwrap().required_probability(), 0.975);
    for (risk, probability) in [(0.025, 0.975), (0.05, 0.975), (0.01, 0.99), (0.015, 0.985)] {
        let found = with(&adaptive(risk)).unwrap().required_probability();
        assert!((found - probability).abs() < 1e-12, "{risk}: {found}");
    }
    let both = changed(RECIPE, "[registration]", &format!("{}\n\n[registration]", adaptive(0.05)));
    let both = changed(&both, "expanded_uncertainty = true", "probability = 0.96");
    assert_eq!(recipe(&both).unwrap().required_probability(), 0.96);
}

#[test]
fn recipe_sets_filter_and_min_coverage() {
    let told = |recipe: &Recipe| {
        let map = &recipe.compensation;
        (map.filter_order, map.roughness, recipe.registration.min_coverage)
    };
    assert_eq!(told(&recipe(RECIPE).unwrap()), (FilterOrder::Plane, SplineSmoothness::Cutoff, 0.5));
    let text = changed(
        RECIPE,
        "[compensation]\n",
        "[compensation]\nfilter_order = \"quadric\"\nroughness = \"cross-validation\"\n",
    );
    let text = changed(&text, "[registration]\n", "[registration]\nleast_coverage = 0.8\n");
    assert_eq!(told(&recipe(&text).unwrap()), (FilterOrder::Quadric, SplineSmoothness::CrossValidation, 0.8));
}

/// Checks that the simulator has the same surface in its own representation.
#[test]
fn simulated_polynomial_equals_nominal() {
    for name in ["freeform-mirror", "shallow-wave"] {
        let recipe = Recipe::read(&root().join(format!("recipes/{name}.toml"))).unwrap();
        let NominalSource::Surface(surface) = &recipe.nominal else { panic!("a formula") };
        let shape = &recipe.simulation.as_ref().unwrap()["part"]["shape"];
        let radius_mm = shape["normalisation_radius_mm"].as_float().unwrap();
        for (x, y) in [(0.0, 0.0), (40.0, 30.0), (-39.0, 12.0), (7.0, -29.0)] {
            let terms = shape["coefficients"].as_array().unwrap().iter();
            let power = |term: &toml::Value, key: &str| term[key].as_integer().unwrap() as i32;
            let z: f64 = terms
                .map(|t| {
                    let (u, v): (f64, f64) = (x / radius_mm, y / radius_mm);
                    t["value_mm"].as_float().unwrap() * u.powi(power(t, "i")) * v.powi(power(t, "j"))
                })
                .sum();
            assert!((z - surface.formula().sag(x, y).unwrap()).abs() < 1e-12, "{name} at {x}, {y}");
        }
    }
}

#[test]
fn biconic_points_match_formula() {
    let path = root().join("recipes/biconic.csv");
    assert!(fs::metadata(&path).unwrap().len() < 150_000);
    let points = read_points(&path).unwrap();
    assert_eq!(points.len(), 61 * 45);
    let formula = "[surface]\nkind = 'biconic'\nradius_x_mm = 140\nradius_y_mm = 90\nconic_x = -0.5\nconic_y = 0.3\n\
                   [aperture]\nkind = 'rectangle'\nwidth_mm = 60\nheight_mm = 44\n";
    let surface = DefinedSurface::from_toml(formula).unwrap();
    for p in &points {
        assert!((surface.formula().sag(p.x, p.y).unwrap() - p.z).abs() < 1e-9);
    }
    let recipe = recipe(BICONIC).unwrap();
    assert!(matches!(&recipe.nominal, NominalSource::File { path: file, .. } if *file == path));
    let shape = &recipe.simulation.as_ref().unwrap()["part"]["shape"];
    assert_eq!(shape["radius_mm"].as_array().unwrap(), &[140.0.into(), 90.0.into()]);
    assert_eq!(shape["conic"].as_array().unwrap(), &[(-0.5).into(), 0.3.into()]);
}

/// Checks places of a measuring plan as another program wrote them: in inches, heights in micrometres, in a table that
/// also has measured values.
#[test]
fn target_file_columns_and_units() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("part.toml");
    let surface = "columns = 60                # 1,800 points\nrows = 30\n";
    let text = fs::read_to_string(root().join("recipes/freeform-mirror.toml")).unwrap();
    assert!(text.contains(surface));
    let given = |keys: &str| {
        let of_file = format!("file = \"plan.csv\"\n{keys}");
        fs::write(&path, text.replace(surface, &of_file).replace("pattern = \"grid\"", "pattern = \"file\"")).unwrap();
        let recipe = Recipe::read(&path).unwrap_or_else(|problems| panic!("{problems}"));
        regrind::setup::prepare(&recipe, &cell(SIM).unwrap()).map(|(task, _)| task.targets.len())
    };
    let row = |k: i32| {
        let (x, y) = (f64::from(k % 10) * 0.25 - 1.125, f64::from(k / 10) * 0.25 - 0.5);
        format!("{k},{x},{y},{},9,9,9\n", 100 * k)
    };
    let rows: String = (0..50).map(row).collect();
    fs::write(home.path().join("plan.csv"), format!("Nr,X_nom [in],Y_nom [in],Z_nom [um],X_act,Y_act,Z_act\n{rows}"))
        .unwrap();
    let columns = "file_columns = \"x=X_nom,y=Y_nom,z=Z_nom\"\n";
    assert_eq!(given(&format!("{columns}file_unit = \"inch\"\nfile_height_unit = \"um\"\n")).unwrap(), 50);
    for missing in ["", columns, &format!("{columns}file_unit = \"inch\"\n")] {
        assert!(matches!(given(missing), Err(SetupError::File(_))), "{missing}");
    }
    assert!(matches!(given("file_columns = \"x,y,z\"\n"), Err(SetupError::Table { key: "measure.file_columns", .. })));
    // A plan has nominal places, and its header says so.
    fs::write(home.path().join("plan.csv"), "X_nom,Y_nom,Z_nom\n1,2,0\n3,4,0\n-8,2,0\n").unwrap();
    assert_eq!(given("").unwrap(), 3);
}

#[test]
fn telescope_locks_weak_directions() {
    let recipe = recipe(TELESCOPE).unwrap();
    assert_eq!(recipe.registration.lock, [Coordinate::X, Coordinate::Y, Coordinate::Rz]);
    assert_eq!(recipe.registration.start, RegistrationStart::Fixture);
    assert_eq!(recipe.measure.side, ProbeSide::Below);
    let cell = cell(FILES).unwrap();
    // opt_global -> mirror frame is p' = Rx (p - s), Rx = [[1, 0, 0], [0, c, -s], [0, s, c]] with tan = 1/2.
    let (sine, cosine) = (0.5f64.atan().sin(), 0.5f64.atan().cos());
    let p = Point::new(2401.0905, -2698.6984, 4819.4921);
    let back = cell.cmm.fixture_cmm_from_model.inverse().transform_point(&p);
    let (y, z) = (p.y, p.z - 3600.0);
    assert!((back - Point::new(p.x, cosine * y - sine * z, sine * y + cosine * z)).norm() < 1e-9);
    let Wire::FileExchange(files) = &cell.cmm.link.wire else { panic!("files") };
    assert_eq!((files.stations.len(), files.unit.in_mm()), (1, 1.0));
    assert_eq!(files.inbox, "../exchange/cmm/in");
    assert_eq!((files.coordinates, files.reference_limit_mm), (Some(Coordinates::Centres), 1.0));
    assert_eq!((files.accept_earlier_files, files.probe_tolerance_mm), (false, 1e-3));
    assert_eq!(recipe.cycle.begin_with, FirstStep::Measure);
    assert_eq!(recipe.compensation.max_displacement_mm, 1.0);
}

#[test]
fn file_exchange_defaults() {
    let text = changed(FILES, "coordinates = \"centres\"", "# coordinates");
    let text = changed(
        &text,
        "accept_earlier_files = false",
        "accept_earlier_files = true\nresult = \"{part}-{job}-{cycle}_*.ply\"",
    );
    let cell = cell(&text).unwrap();
    let Wire::FileExchange(files) = &cell.cmm.link.wire else { panic!("files") };
    assert_eq!((files.coordinates, files.accept_earlier_files), (None, true));
    assert_eq!(files.result, "{part}-{job}-{cycle}_*.ply");
    let Wire::FileExchange(files) = &cell.grinder.link.wire else { panic!("files") };
    assert_eq!((files.result.as_str(), files.reference_limit_mm), ("{part}_c{cycle}.*", 0.1));
    let recipe = recipe(RECIPE).unwrap();
    assert_eq!(recipe.cycle.begin_with, FirstStep::Grind);
    assert_eq!(recipe.compensation.max_displacement_mm, 1.0);
}

#[test]
fn cell_registers_and_signals() {
    let text = changed(
        TCP,
        "# status = 64",
        "status = 600\n[[cmm.signals]]\nname = 'air'\naddress = 1000\ntype = 'f32'\nrange = [4, 8]",
    );
    let cell = cell(&text).unwrap();
    assert_eq!((cell.cmm.link.registers.status, cell.cmm.link.registers.command), (600, 40));
    assert_eq!(cell.cmm.link.signals[0].range, [4.0, 8.0]);
    assert_eq!(cell.cmm.link.signals[0].word_order, WordOrder::Big);
    assert_eq!(cell.grinder.link.wire, Wire::ModbusTcp(TcpWire { host: "127.0.0.1".into(), port: 15022, unit: 2 }));
}

/// File, key, bad value, and a word of the remedy or limit. The only problem is reported at the value.
type BadValue = (&'static str, &'static str, &'static str, &'static str);

const BAD_RECIPE_VALUES: &[BadValue] = &[
    (RECIPE, "measure.probe_radius_mm", "1500", "write 1.5 (mm)"),
    (RECIPE, "measure.probe_radius_mm", "'1.5'", "remove the quotes: 1.5"),
    (RECIPE, "measure.probe_radius_mm", "'1,5'", "decimal point"),
    (RECIPE, "measure.probe_radius_mm", "nan", "0.05 to 50 mm"),
    (RECIPE, "measure.probe_radius_mm", "-inf", "the usual value is 1.5"),
    (RECIPE, "measure.probe_radius_mm", "'1.5 mm'", "without its unit"),
    (RECIPE, "measure.columns", "60.5", "without a decimal point"),
    (RECIPE, "measure.pattern", "\"gird\"", "did you mean \"grid\""),
    (RECIPE, "measure.side", "\"left\"", "\"below\""),
    (RECIPE, "measure.edge_margin_mm", "31", "lower `edge_margin_mm`"),
    (RECIPE, "measure.safe_height_mm", "1.0", "raise `safe_height_mm`"),
    (RECIPE, "measure.min_coverage", "95", "0.1 to 1"),
    (RECIPE, "measure.qualify", "\"yes\"", "true or false"),
    (RECIPE, "acceptance.pv_um", "0.5", "swapped"),
    (RECIPE, "compensation.depth_of_cut_um", "500.0", "budget"),
    (RECIPE, "compensation.max_correction_um", "600", "budget"),
    (RECIPE, "compensation.cutoff_mm", "3.0", "measure more points"),
    (BICONIC, "compensation.cutoff_mm", "1.5", "twice the spacing"),
    (RECIPE, "grinding.feed_mm_min", "0", "mm/min"),
    (RECIPE, "grinding.track_mm", "13.0", "lower `track_mm`"),
    (RECIPE, "grinding.allowance_um", "90.0", "max_cycles"),
    (RECIPE, "grinding.wheel.shape", "\"cone\"", "\"torus\""),
    (RECIPE, "grinding.wheel.radius_mm", "120.0", "smaller"),
    (RECIPE, "cycle.max_cycles", "0", "1 to 100"),
    (RECIPE, "cycle.on_stall", "\"go\"", "\"hold\""),
    (RECIPE, "registration.max_rms_um", "0.5", "raise `max_rms_um`"),
    (RECIPE, "part.name", "\"\"", "1 to 80"),
    (RECIPE, "part.name", "\"two\\nlines\"", "line breaks"),
    (RECIPE, "nominal.aperture.width_mm", "-102.0", "-102"),
    (BICONIC, "nominal.projection", "\"yx\"", "best-fit"),
    (RECIPE, "measure.points", "1800", "remove this key"),
    (RECIPE, "compensation.gain", "1.5", "1.2"),
    (RECIPE, "registration.lock", "[\"x\"]", "fixture"),
];

const BAD_CELL_VALUES: &[BadValue] = &[
    (SIM, "cell.simulated", "1", "without quotes"),
    (TCP, "cmm.wire.port", "70000", "0 to 65535"),
    (TCP, "cmm.wire.kind", "\"modbus\"", "modbus-rtu"),
    (TCP, "cmm.wire.host", "\"192.168.0.5\"", "simulated = false"),
    (TCP, "cmm.wire.host", "\"http://a\"", "into its own key"),
    (TCP, "cmm.timing.heartbeat_ms", "900", "20 to 500"),
    (TCP, "cmm.timing.lost_after_ms", "1500", "retries"),
    (TCP, "cmm.travel.min_mm", "[600.0, -500.0, -300.0]", "swapped"),
    (TCP, "cmm.reference_sphere.centre_mm", "[0.0, 1200.0, 20.0]", "outside"),
    (TCP, "grinder.limits.min_wheel_radius_mm", "200", "no wheel"),
    (RTU, "cmm.wire.parity", "\"evn\"", "did you mean \"even\""),
    (RTU, "cmm.wire.stop_bits", "3", "1 to 2"),
    (FILES, "cell.simulated", "true", "simulated = false"),
    (FILES, "cmm.wire.inbox", "\"../exchange/cmm/out\"", "different folders"),
    (FILES, "cmm.wire.reference_limit_mm", "0", "100"),
    (FILES, "cmm.wire.unit", "\"furlong\"", "inch"),
    (TCP, "cmm.registers.status", "50", "overlaps"),
    (TCP, "cmm.registers.in_force", "65500", "65535"),
    (TCP, "cmm.registers.word_order", "\"middle\"", "little"),
    (FILES, "cmm.wire.result", "\"{part}/{cycle}.csv\"", "the usual name"),
    (FILES, "cmm.fixture.rotation_deg", "[0.0, 0.0]", "there must be 3"),
];

/// File, text to replace, its replacement, and the only problem: its key, the text at its position, and a word of its
/// remedy or limit.
type BadText = (&'static str, &'static str, &'static str, &'static str, &'static str, &'static str);

const BAD_RECIPES: &[BadText] = &[
    (
        RECIPE,
        "probe_radius_mm = 1.5",
        "probe_radius_um = 1.5",
        "measure.probe_radius_um",
        "probe_radius_um",
        "mean `probe_radius_mm`",
    ),
    (RECIPE, "probe_radius_mm = 1.5\n", "", "measure.probe_radius_mm", "measure]", "`probe_radius_mm = 1.5`"),
    (RECIPE, "rows = 30", "spacing_mm = 2.0", "measure", "measure]", "`columns` and `rows`"),
    (RECIPE, "rows = 30", "rows = 30\nspacing_mm = 2.0", "measure", "measure]", "exactly these"),
    (SPIRAL, "points = 1500", "spacing_mm = 0.008", "measure.spacing_mm", "0.008", "coarser"),
    (SPIRAL, "points = 1500", "spacing_mm = 80", "measure.spacing_mm", "80", "finer"),
    (
        RECIPE,
        "probe_radius_mm = 1.5\n",
        "probe_radius_mm = 1.5\nmode = \"adaptive\"\n",
        "measure.accepted_risk",
        "measure]",
        "accepted_risk = 0.025",
    ),
    (
        RECIPE,
        "probe_radius_mm = 1.5\n",
        "probe_radius_mm = 1.5\naccepted_risk = 0.025\n",
        "measure.accepted_risk",
        "0.025",
        "remove `accepted_risk`",
    ),
    (
        RECIPE,
        "probe_radius_mm = 1.5\n",
        "probe_radius_mm = 1.5\nmode = \"adaptive\"\naccepted_risk = 0.5\n",
        "measure.accepted_risk",
        "0.5",
        "0.1",
    ),
    (
        RECIPE,
        "probe_radius_mm = 1.5\n",
        "probe_radius_mm = 1.5\nmode = \"clever\"\n",
        "measure.mode",
        "\"clever\"",
        "\"adaptive\"",
    ),
    (
        RECIPE,
        "expanded_uncertainty = true",
        "expanded_uncertainty = false\n[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025",
        "acceptance.expanded_uncertainty",
        "false",
        "fixed",
    ),
    (
        RECIPE,
        "expanded_uncertainty = true",
        "expanded_uncertainty = false\nprobability = 0.99",
        "acceptance.probability",
        "0.99",
        "remove `probability`",
    ),
    (RECIPE, "expanded_uncertainty = true", "probability = 0.3", "acceptance.probability", "0.3", "0.5"),
    (RECIPE, "expanded_uncertainty = true", "probability = nan", "acceptance.probability", "nan", "0.995"),
    (
        RECIPE,
        "expanded_uncertainty = true",
        "probability = 0.95\n[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025",
        "measure.accepted_risk",
        "0.025",
        "`accepted_risk` to 0.050",
    ),
    (
        RECIPE,
        "expanded_uncertainty = true",
        "probability = 0.95\n[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025",
        "measure.accepted_risk",
        "0.025",
        "probability` to 0.975",
    ),
    (
        RECIPE,
        "qualify = true              # touch the reference sphere first\nradius_tolerance_um = 2.0\n",
        "qualify = false\n[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025\n",
        "measure.qualify",
        "false",
        "fixed",
    ),
    (RECIPE, "[acceptance]", "[acceptence]", "acceptence", "acceptence", "mean `acceptance`"),
    (RECIPE, "pv_um = 7.0\nrms_um = 1.0\n", "", "acceptance", "acceptance]", "add `rms_um = 1.0`"),
    (RECIPE, "cutoff_mm = 5.0 ", "gian = 5.0 \ncutoff_mm = 5.0", "compensation.gian", "gian", "did you mean `gain`"),
    (RECIPE, "shape = \"sphere\"", "", "grinding.wheel.shape", "wheel]", "add `shape"),
    (
        RECIPE,
        "shape = \"sphere\"",
        "shape = \"torus\"\nminor_radius_mm = 20",
        "grinding.wheel.minor_radius_mm",
        "20\nradius",
        "swapped",
    ),
    (
        RECIPE,
        "start = \"search\"",
        "start = \"fixture\"\nlock = [\"x\", \"u\"]",
        "registration.lock[1]",
        "\"u\"",
        "\"rz\"",
    ),
    (
        RECIPE,
        "max_rms_um = 100.0",
        "max_rms_um = 100.0\npv_um = 1",
        "registration.pv_um",
        "pv_um",
        "move it to [acceptance]",
    ),
    (RECIPE, "[part]", "[part]\nnominal = 1", "part.nominal", "nominal", "the top of the file"),
    (
        RECIPE,
        "kind = \"xy-polynomial\"\nnormalisation_radius_mm = 50.0\nterms",
        "kind = \"xy-polynom\"\nnormalisation_radius_mm = 50.0\nterms",
        "nominal.surface.kind",
        "\"xy-polynom\"",
        "mean \"xy-polynomial\"",
    ),
    (RECIPE, "[1, 0, 2.1]", "[1, 0]", "nominal.surface.terms[0]", "[1, 0]", "there must be 3"),
    (RECIPE, "[1, 0, 2.1]", "[1, -1, 2.1]", "nominal.surface.terms[0][1]", "-1", "0 to 60"),
    (RECIPE, "[1, 0, 2.1]", "[0, 1, 2.1]", "nominal.surface.terms", "[   ", "twice"),
    (
        RECIPE,
        "width_mm = 102.0",
        "wide_mm = 102.0\nwidth_mm = 102.0",
        "nominal.aperture.wide_mm",
        "wide_mm",
        "did you mean `width_mm`",
    ),
    (RECIPE, "accuracy_nm = 0.5", "accuracy_nm = 0.5\nspacing_mm = 1", "nominal.sampling", "sampling]", "exactly one"),
    (BICONIC, "projection = \"xy\"", "sampling = { spacing_mm = 1 }", "nominal.sampling", "sampling", "nominal.file"),
];

const BAD_CELLS: &[BadText] = &[
    (
        TCP,
        "[cmm]\n",
        "[cmm]\ncalibration_due = \"2027-02-29\"\n",
        "cmm.calibration_due",
        "\"2027-02-29\"",
        "2027-03-31",
    ),
    (
        TCP,
        "[cmm]\n",
        "[cmm]\ncalibration_due = \"31.03.2027\"\n",
        "cmm.calibration_due",
        "\"31.03.2027\"",
        "2027-03-31",
    ),
    (
        TCP,
        "[cmm]\n",
        "[cmm]\ncalibration_due = \"2027-13-01\"\n",
        "cmm.calibration_due",
        "\"2027-13-01\"",
        "2027-03-31",
    ),
    (
        TCP,
        "# [cmm.uncertainty]",
        "[cmm.uncertainty]\nscale_ppm = [0.5, -0.5, 0.5]\n#",
        "cmm.uncertainty.scale_ppm[1]",
        "-0.5, 0.5]",
        "0 to 1000",
    ),
    (
        TCP,
        "# [cmm.uncertainty]",
        "[cmm.uncertainty]\nscale_ppm = [0.5, 0.5]\n#",
        "cmm.uncertainty.scale_ppm",
        "[0.5, 0.5]",
        "3",
    ),
    (
        TCP,
        "# [cmm.uncertainty]",
        "[cmm.uncertainty]\nsquareness_urad = [1.0, nan, 1.0]\n#",
        "cmm.uncertainty.squareness_urad[1]",
        "nan, 1.0]",
        "0 to 10000",
    ),
    (
        TCP,
        "# [cmm.uncertainty]",
        "[cmm.uncertainty]\nprobe_um = 2000.0\n#",
        "cmm.uncertainty.probe_um",
        "2000.0",
        "0 to 1000",
    ),
    (
        TCP,
        "# [cmm.uncertainty]",
        "[cmm.uncertainty]\nreference_sphere_um = -0.05\n#",
        "cmm.uncertainty.reference_sphere_um",
        "-0.05",
        "0 to 1000",
    ),
    (
        TCP,
        "# [cmm.uncertainty]",
        "[cmm.uncertainty]\nreference_sphere_mm = 0.05\n#",
        "cmm.uncertainty.reference_sphere_mm",
        "reference_sphere_mm",
        "did you mean",
    ),
    (TILTING, "min_deg = -60.0", "min_deg = 70.0", "grinder.rotary.min_deg", "70.0", "swapped"),
    (TILTING, "axis = \"B\"", "axis = \"C\"", "grinder.rotary.axis", "\"C\"", "one of"),
    (TILTING, "reversed = false", "turns = \"table\"", "grinder.rotary.turns", "\"table\"", "stays upright"),
    (TILTING, "max_rate_deg_min = 3600.0\n", "", "grinder.rotary.max_rate_deg_min", "rotary]", "add `max"),
    (SIM, "simulated = true ", "simulated = false ", "cmm.wire.port", "0                    #", "1 to 65535"),
    (SIM, "name = \"simulated cell\"\n", "", "cell.name", "cell]", "add `name"),
    (TCP, "port = 15021", "prot = 15021\nport = 1", "cmm.wire.prot", "prot", "did you mean `port`"),
    (TCP, "port = 15022\nunit = 2", "port = 15021\nunit = 1", "grinder.wire.unit", "1\n\n[grinder.limits", "own unit"),
    (
        TCP,
        "# expected_name",
        "[[cmm.signals]]\nname = 'a'\naddress = 65535\ntype = 'u32'\nrange = [0, 1]\n#",
        "cmm.signals[0].address",
        "65535",
        "lower it",
    ),
    (
        TCP,
        "# expected_name",
        "[[cmm.signals]]\nname = 'a'\naddress = 1\ntype = 'u8'\nrange = [0, 1]\n#",
        "cmm.signals[0].type",
        "'u8'",
        "u16",
    ),
    (
        TCP,
        "# expected_name",
        "[[cmm.signals]]\nname = 'a'\naddress = 1\ntype = 'u16'\nrange = [1, 0]\n#",
        "cmm.signals[0].range",
        "[1, 0]",
        "swap",
    ),
    (TCP, "max_depth_mm = 0.5\n", "", "grinder.limits.max_depth_mm", "limits]", "add `max_depth_mm"),
    (
        RTU,
        "device = \"/tmp/regrind-grinder.tty\"\nbaud = 115200",
        "device = \"/tmp/regrind-cmm.tty\"\nbaud = 9600",
        "grinder.wire",
        "wire]\nkind = \"modbus-rtu\"\ndevice = \"/tmp/regrind-cmm.tty\"\nbaud = 9600",
        "one setting",
    ),
    (
        FILES,
        "reference = \"ref_*.yaml\"",
        "reference = \"ref.yaml\"",
        "cmm.wire.stations[0].reference",
        "\"ref.yaml\"",
        "add the `*`",
    ),
    (
        FILES,
        "reference_points = \"../exchange/cmm/reference.yaml\"\n",
        "",
        "cmm.wire.stations",
        "[[cmm.wire.stations]]",
        "name their file",
    ),
];

/// Sets a key of a file to another value, and adds the key if it is missing. Returns the position at which the value
/// begins.
fn with_value(file: &str, key: &str, value: &str) -> (String, usize) {
    let (table, name) = key.rsplit_once('.').expect("a key within a table");
    let header = format!("\n[{table}]");
    let begins = file.find(&header).unwrap_or_else(|| panic!("no [{table}]")) + header.len();
    let body = &file[begins..];
    let body = &body[..body.find("\n[").unwrap_or(body.len())];
    let line = format!("\n{name} = ");
    match body.find(&line) {
        Some(k) => {
            let at = begins + k + line.len();
            let ends = at + file[at..].find(['\n', '#']).unwrap_or(0);
            (format!("{}{value} {}", &file[..at], &file[ends..]), at)
        }
        None => {
            let at = begins + body.find('\n').unwrap_or(0);
            (format!("{}{line}{value}{}", &file[..at], &file[at..]), at + line.len())
        }
    }
}

/// Reads a damaged text. Returns the description of a wrong report; none if the only problem is at its position with a
/// word of its remedy.
fn not_told<T>(text: &str, at: usize, key: &str, word: &str, read: fn(&str) -> Result<T, Problems>) -> Option<String> {
    let Err(problems) = read(text) else { return Some("it was taken".to_owned()) };
    let Some(problem) = problems.problems.iter().find(|problem| problem.key == key) else {
        return Some(format!("nothing about `{key}`:\n{problems}"));
    };
    let expected = place_of_byte(text, at);
    let wrong = problems.problems.len() > 1 && !ALSO.contains(&key)
        || problems.place(problem) != expected
        || !problem.to_string().contains(word);
    wrong.then(|| format!("expected `{word}` at {expected:?} in:\n{problems}"))
}

fn assert_told<T>(values: &[BadValue], texts: &[BadText], read: fn(&str) -> Result<T, Problems>) {
    let by_value = values.iter().filter_map(|(file, key, value, word)| {
        let (text, at) = with_value(file, key, value);
        not_told(&text, at, key, word, read).map(|why| format!("{key} = {value}: {why}"))
    });
    let by_text = texts.iter().filter_map(|(file, from, to, key, needle, word)| {
        let text = changed(file, from, to);
        // Search the needle from the change on; the name of the table is before it.
        let changed_at = text.find(to).unwrap_or(0);
        let at = text[changed_at..].find(needle).map(|k| changed_at + k).or_else(|| text.find(needle));
        let at = at.unwrap_or_else(|| panic!("`{needle}` must stand in the text"));
        not_told(&text, at, key, word, read).map(|why| format!("{from} -> {to}: {why}"))
    });
    let wrong: Vec<String> = by_value.chain(by_text).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n\n"));
}

/// Keys whose bad values cause a second problem as well.
const ALSO: &[&str] = &["cmm.wire.port", "cmm.wire.kind"];

fn place_of_byte(text: &str, at: usize) -> (usize, usize) {
    let line_start = text[..at].rfind('\n').map_or(0, |newline| newline + 1);
    (text[..at].matches('\n').count() + 1, text[line_start..at].chars().count() + 1)
}

#[test]
fn bad_recipe_reports_position() {
    assert_told(BAD_RECIPE_VALUES, BAD_RECIPES, recipe);
}

#[test]
fn bad_cell_reports_position() {
    assert_told(BAD_CELL_VALUES, BAD_CELLS, cell);
}

#[test]
fn tilt_refuses_two_axes_and_ball_pole() {
    let two = TILTING.replace("[grinder.rotary]", "[[grinder.rotary]]");
    let told = cell(&two).unwrap_err().to_string();
    assert!(told.contains("grinder.rotary") && told.contains("table"), "{told}");
    let pole = format!("{}\n[grinding.tilt]\nlean = \"following\"\nangle_deg = 1.0\n", RECIPE);
    let told = recipe(&pole).unwrap_err().to_string();
    assert!(told.contains("grinding.tilt.angle_deg") && told.contains("pole"), "{told}");
    assert!(recipe(&pole.replace("angle_deg = 1.0", "angle_deg = 20.0")).is_ok());
}

#[test]
fn recipe_reports_all_problems_in_order() {
    let text = RECIPE
        .replace("probe_radius_mm = 1.5", "probe_radius_mm = 1500")
        .replace("edge_margin_mm", "edge_margin")
        .replace("pv_um = 7.0", "pv_um = 0.5")
        .replace("depth_of_cut_um = 20.0", "depth_of_cut_um = 500.0")
        .replace("shape = \"sphere\"", "shape = \"spere\"")
        .replace("max_cycles = 5", "max_cycles = \"five\"");
    let problems = recipe(&text).unwrap_err();
    let keys: Vec<&str> = problems.problems.iter().map(|problem| problem.key.as_str()).collect();
    assert_eq!(
        keys,
        [
            "measure.probe_radius_mm",
            "measure.edge_margin",
            "acceptance.pv_um",
            "compensation.depth_of_cut_um",
            "grinding.wheel.shape",
            "cycle.max_cycles"
        ]
    );
    let lines: Vec<usize> = problems.problems.iter().map(|problem| problems.place(problem).0).collect();
    assert!(lines.is_sorted());
    assert_eq!(problems.to_string().lines().count(), 6);
}

#[test]
fn recipe_reports_all_syntax_errors() {
    let text = changed(RECIPE, "depth_of_cut_um = 20.0", "depth_of_cut_um 20.0");
    let text = changed(&text, "track_mm = 0.24", "track_mm = = 0.24");
    let problems = recipe(&text).unwrap_err();
    assert!(problems.problems.len() >= 2, "{problems}");
    let lines: Vec<usize> = problems.problems.iter().map(|problem| problems.place(problem).0).collect();
    for needle in ["depth_of_cut_um 20.0", "track_mm = = 0.24"] {
        assert!(lines.contains(&place_of(&text, needle).0), "{problems}");
    }
}

#[test]
fn old_key_names_read_with_note() {
    let new = changed(
        RECIPE,
        "probe_radius_mm = 1.5\n",
        "probe_radius_mm = 1.5\nmode = \"adaptive\"\naccepted_risk = 0.025\n",
    );
    let text =
        changed(RECIPE, "[registration]", "[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025\n\n[registration]");
    let text = text.replace("min_coverage", "minimum_coverage").replace("max_shift_mm", "largest_shift_mm");
    let text = text.replace("max_cycles", "most_cycles");
    let [old, new] = [text, new].map(|text| Recipe::parse(Path::new("recipes/freeform-mirror.toml"), &text).unwrap());
    assert_eq!((&old.measure, &old.registration, &old.cycle), (&new.measure, &new.registration, &new.cycle));
    assert_eq!((old.notes().len(), new.notes().len()), (5, 0), "{:?}", old.notes());
    assert!(old.notes().iter().any(|note| note.contains("`cycle.most_cycles`") && note.contains("`cycle.max_cycles`")));
}

#[test]
fn old_and_new_key_name_refused() {
    let text = changed(RECIPE, "max_cycles = 5", "max_cycles = 5\nmost_cycles = 4");
    let problems = Recipe::parse(Path::new("recipes/freeform-mirror.toml"), &text).unwrap_err();
    assert_eq!(problems.problems.len(), 1, "{problems}");
    assert_eq!(problems.problems[0].key, "cycle.most_cycles");
    assert_eq!(problems.place(&problems.problems[0]), place_of_byte(&text, text.find("most_cycles").unwrap()));
}

#[test]
fn recipe_refuses_non_text_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recipe.toml");
    let read = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        Recipe::read(&path).unwrap_err().to_string()
    };
    assert!(read(b"a = 1,5").contains("decimal point"));
    assert!(read(b"[part]\nname = \"\xff\"").contains("line 2 is not UTF-8"));
    assert!(read(b"[part]\n\0\0").contains("NUL"));
    assert!(read(&vec![b'#'; 300 << 10]).contains("256 KiB"));
    assert!(read(b"").contains("[measure]"));
    assert!(Recipe::read(folder.path()).unwrap_err().to_string().contains("cannot be read"));
    assert!(CellConfig::read(&folder.path().join("none")).unwrap_err().to_string().contains("cannot be read"));
    let utf16: Vec<u8> = RECIPE.encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert!(read(&utf16).contains("invalid TOML"));
    fs::write(&path, format!("\u{feff}{RECIPE}").replace('\n', "\r\n")).unwrap();
    assert!(Recipe::read(&path).is_ok(), "a mark of the byte order and Windows line ends are no fault");
}

#[test]
fn recipe_limits_nesting_and_problems() {
    for text in [
        format!("a = {}{}", "[".repeat(20_000), "]".repeat(20_000)),
        format!("a = {}1{}", "{ a = ".repeat(5_000), "}".repeat(5_000)),
        format!("[{}a]", "a.".repeat(20_000)),
        "x = 1e999999\n".to_owned(),
        "x = 99999999999999999999999\n".to_owned(),
    ] {
        assert!(recipe(&text).is_err() && cell(&text).is_err());
    }
    let many: String = (0..5_000).map(|k| format!("unknown{k} = 1\n")).collect();
    let problems = recipe(&many).unwrap_err();
    assert!(problems.problems.len() <= 201);
    assert!(problems.to_string().contains("more problems"));
}

#[test]
fn recipe_problem_locates_key() {
    let recipe = recipe(RECIPE).unwrap();
    let problems = recipe.problem("simulation.part.stock_um", "is 200", "it must be 0 to 100", "lower it");
    let (line, column) = problems.place(&problems.problems[0]);
    assert_eq!((line, column), place_of(RECIPE, "200.0"));
    let problem = &problems.problems[0];
    assert_eq!(problem.key, "simulation.part.stock_um");
    assert_eq!([&problem.found, &problem.allowed, &problem.remedy], ["is 200", "it must be 0 to 100", "lower it"]);
    for piece in ["simulation.part.stock_um", "is 200", "it must be 0 to 100", "lower it"] {
        assert!(problems.to_string().contains(piece), "{problems}");
    }
}

#[test]
fn check_reports_text_and_json() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.toml");
    fs::write(&path, changed(BICONIC, "biconic.csv", "none.csv")).unwrap();
    let good = root().join("config/sim.toml");
    let run = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_regrind"));
        command.arg("check").args(arguments).arg(&path).arg(&good).output().unwrap()
    };
    let output = run(&[]);
    let (told, error) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert_eq!(output.status.code(), Some(2));
    assert!(told.contains("sim.toml") && told.contains("good cell file"), "{told}");
    assert!(error.contains("nominal.file") && error.contains("none.csv") && error.contains("1 of 2 files"), "{error}");
    let output = run(&["--json"]);
    assert_eq!(output.status.code(), Some(2));
    let document: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(document[0]["problems"][0]["key"], "nominal.file");
    assert_eq!(document[0]["problems"][0]["line"], place_of(BICONIC, "file = ").0);
    assert_eq!((&document[0]["good"], &document[1]["good"]), (&false.into(), &true.into()));
}

#[test]
fn check_validates_simulation_table() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recipe.toml");
    for (to, pieces) in [
        ("stock_um = -1.0", &["simulation.part.stock_um", "is -1", "0 to 10000"][..]),
        ("stok_um = 200.0", &["`simulation`", "stok_um"]),
    ] {
        fs::write(&path, changed(RECIPE, "stock_um = 200.0", to)).unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_regrind")).arg("check").arg(&path).output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(pieces.iter().all(|piece| error.contains(piece)), "{error}");
    }
}

/// The known zero: the parts of the shipped recipes are accepted, so no plan expects a refusal or another unit.
#[test]
fn plans_of_shipped_recipes_expect_no_refusal() {
    for name in ["biconic", "freeform-mirror", "off-axis-asphere", "shallow-wave"] {
        let path = root().join(format!("recipes/{name}.toml"));
        let output = Command::new(env!("CARGO_BIN_EXE_regrind")).arg("plan").arg(&path).arg("--json").output().unwrap();
        let plan: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(plan["warnings"], Value::Array(Vec::new()), "{name}");
    }
}

#[test]
fn committed_schemas_are_current() {
    let schemas = [
        ("cell", regrind::config::json_schema()),
        ("dialect", regrind::config::dialect_schema()),
        #[cfg(feature = "plant")]
        ("plant", regrind::config::plant_schema()),
    ];
    for (name, schema) in schemas {
        let committed = fs::read_to_string(root().join(format!("docs/{name}.schema.json"))).unwrap();
        let committed: Value = serde_json::from_str(&committed).unwrap();
        assert_eq!(&committed, schema, "write it anew: regrind schema {name} > docs/{name}.schema.json");
        let output = Command::new(env!("CARGO_BIN_EXE_regrind")).args(["schema", name]).output().unwrap();
        assert_eq!(&serde_json::from_slice::<Value>(&output.stdout).unwrap(), schema);
    }
    if cfg!(feature = "plant") {
        let committed = fs::read_to_string(root().join("docs/notification.schema.json")).unwrap();
        let committed: Value = serde_json::from_str(&committed).unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_regrind")).args(["schema", "notification"]).output().unwrap();
        let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(committed, printed, "write it anew: regrind schema notification > docs/notification.schema.json");
    }
    // The program adds the keys of the simulator to those that the library declares.
    let committed = fs::read_to_string(root().join("docs/recipe.schema.json")).unwrap();
    let committed: Value = serde_json::from_str(&committed).unwrap();
    assert_eq!(&committed, recipe_schema(), "write it anew: regrind schema recipe > docs/recipe.schema.json");
    let mut declared = committed;
    let simulation = &mut declared["properties"]["simulation"];
    assert!(simulation["properties"]["grinder"]["properties"]["wear_um"].is_object());
    *simulation = regrind::recipe::json_schema()["properties"]["simulation"].clone();
    assert_eq!(&declared, regrind::recipe::json_schema());
}

/// Returns the schema of recipes that the program prints.
fn recipe_schema() -> &'static Value {
    static SCHEMA: LazyLock<Value> = LazyLock::new(|| {
        let output = Command::new(env!("CARGO_BIN_EXE_regrind")).args(["schema", "recipe"]).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap()
    });
    &SCHEMA
}

/// Evaluates the few keywords of JSON schema that our schemas use, with an independent implementation.
fn accepts(schema: &Value, value: &Value) -> bool {
    if let Some(variants) = schema.get("oneOf").and_then(Value::as_array) {
        return variants.iter().filter(|one| accepts(one, value)).count() == 1;
    }
    let words = schema.get("enum").and_then(Value::as_array);
    if words.is_some_and(|words| !words.contains(value)) || schema.get("const").is_some_and(|one| one != value) {
        return false;
    }
    let limit = |key: &str, otherwise: f64| schema.get(key).and_then(Value::as_f64).unwrap_or(otherwise);
    let within = |number: f64, least: &str, most: &str| {
        (limit(least, f64::NEG_INFINITY)..=limit(most, f64::INFINITY)).contains(&number)
    };
    match (schema["type"].as_str().expect("a type"), value) {
        ("boolean", Value::Bool(_)) => true,
        ("string", Value::String(text)) => within(text.chars().count() as f64, "minLength", "maxLength"),
        ("integer", Value::Number(number)) if !number.is_f64() => {
            within(number.as_f64().unwrap(), "minimum", "maximum")
        }
        ("number", Value::Number(number)) => within(number.as_f64().unwrap(), "minimum", "maximum"),
        ("array", Value::Array(items)) => {
            within(items.len() as f64, "minItems", "maxItems")
                && items.iter().enumerate().all(|(k, item)| {
                    let one = schema.get("prefixItems").and_then(|each| each.get(k)).or_else(|| schema.get("items"));
                    one.is_none_or(|one| accepts(one, item))
                })
        }
        ("object", Value::Object(table)) => {
            let required = schema.get("required").and_then(Value::as_array).into_iter().flatten();
            required.into_iter().all(|key| table.contains_key(key.as_str().unwrap()))
                && table.iter().all(|(key, value)| {
                    match (schema["properties"].get(key), &schema["additionalProperties"]) {
                        (Some(schema), _) => accepts(schema, value),
                        (None, Value::Bool(allowed)) => *allowed,
                        (None, Value::Null) => true,
                        (None, schema) => accepts(schema, value),
                    }
                })
        }
        _ => false,
    }
}

#[test]
fn schemas_accept_shipped_files_only() {
    for (folder, schema) in [
        ("recipes", recipe_schema()),
        ("config", regrind::config::json_schema()),
        ("config/dialects", regrind::config::dialect_schema()),
    ] {
        for path in shipped(folder) {
            let text = fs::read_to_string(&path).unwrap();
            let value = serde_json::to_value(toml::from_str::<toml::Table>(&text).unwrap()).unwrap();
            assert!(accepts(schema, &value), "{}", path.display());
            for table in ["measure", "cmm", "simulation"] {
                let mut broken = value.clone();
                if broken.get(table).is_some() {
                    broken[table]["unheard_of"] = 1.into();
                    assert!(!accepts(schema, &broken));
                }
            }
        }
    }
}

fn shipped_texts() -> [&'static str; 8] {
    [RECIPE, BICONIC, SPIRAL, TELESCOPE, SIM, TCP, RTU, FILES]
}

/// Reads a text as both kinds of file, and formats every problem.
fn survive(text: &str) {
    for problems in [recipe(text).err(), cell(text).err()].into_iter().flatten() {
        assert!(!problems.problems.is_empty());
        for problem in &problems.problems {
            assert!(text.get(problem.span.clone()).is_some(), "{problem}");
            assert!(problems.place(problem) >= (1, 1));
        }
        assert!(!problems.to_string().is_empty());
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, ..ProptestConfig::default() })]

    #[test]
    fn any_text_is_read_or_refused(text in "\\PC{0,200}|[\\[\\]{}=\"'.,#a-z0-9_\n -]{0,300}") {
        survive(&text);
    }

    #[test]
    fn mutated_files_are_read_or_refused(
        which in 0usize..8,
        cuts in prop::collection::vec((0.0f64..1.0, 0usize..12, "[\\[\\]{}=\"'.,#a-z0-9_\n\u{0}é-]{0,6}"), 1..6),
    ) {
        let mut text = shipped_texts()[which].to_owned();
        for (at, length, with) in cuts {
            let boundary = |k: usize| (k..=text.len()).find(|&k| text.is_char_boundary(k)).unwrap_or(text.len());
            let start = boundary((at * text.len() as f64) as usize);
            let end = boundary((start + length).min(text.len()));
            text.replace_range(start..end, &with);
        }
        survive(&text);
    }

    #[test]
    fn swapped_values_are_read_or_refused(which in 0usize..8, line in 0usize..200, value in prop::sample::select(vec![
        "0", "-1", "1e308", "nan", "inf", "-inf", "''", "[]", "{}", "[[]]", "true", "1979-05-27", "9223372036854775807",
        "[1, 2, 3, 4]", "{ kind = 'plane' }", "'x'",
    ])) {
        let lines: Vec<&str> = shipped_texts()[which].lines().collect();
        let line = line % lines.len();
        let text: String = lines.iter().enumerate().map(|(k, text)| match text.split_once(" = ") {
            Some((key, _)) if k == line && !key.starts_with('#') => format!("{key} = {value}\n"),
            _ => format!("{text}\n"),
        }).collect();
        survive(&text);
    }
}
