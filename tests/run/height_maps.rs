//! A height map as the measurement: from an interferometer's file, through the folders of a measuring machine, to an
//! accepted part.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::program::{self, changed, root};
use crate::worlds::header;
use nalgebra::{Matrix6, Vector6};
use regrind::cell::{Actor, Ending, Role};
use regrind::config::CellConfig;
use regrind::device::file_exchange::{CmmExchange, CmmFolders, Exchange, MeasureOrder, Permit};
use regrind::device::{Coordinates, Identified, Job, Measurement, Plan, digest};
use regrind::drive::{BlockingExecutor, CycleRow, Drive, JournalSink, Notice, RunInputs};
use regrind::formats::result::{Content, Coordinates as Said};
use regrind::formats::{self, FormatError, HeightMap, MapRecord, X3pFile, read_measured, read_x3p, write_x3p};
use regrind::geometry::{Grid, Pose};
use regrind::journal::Journal;
use regrind::recipe::Recipe;
use regrind::setup;
use regrind_sim::Vec3;
use regrind_sim::options::MachineOptions;
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::shape::{FreeForm, Shape};
use regrind_sim::spec::WorldSpec;
use regrind_sim::wire::Serving;
use regrind_sim::world::World;
use serde_json::Value;
use tokio::sync::mpsc;

/// Upper bound of the duration of a run, even on a loaded computer.
const PATIENCE: Duration = Duration::from_secs(300);
const SPEED: f64 = 50_000.0;

// ---- the interferometer -------------------------------------------------------------------------------------------------------------

/// Number of samples along x and y. The part is 102 x 62 mm.
const SIZE: [usize; 2] = [120, 80];
const PITCH_MM: f64 = 0.9;
/// Position of the picture's lower left sample in the frame of the fixture, in mm.
const CORNER_MM: [f64; 2] = [-53.5, -35.5];

/// Rounds a length to single precision, as MetroPro stores metres.
fn real(value: f64) -> f32 {
    value as f32
}

/// Interferometer that looks down on the part. Its heights are in the fixture's frame, and each picture has its own
/// height offset.
struct Interferometer {
    world: World,
    pictures: u32,
}

impl Interferometer {
    /// Returns the height of the real surface at a position in the fixture's frame, or `None` off the part.
    fn height(&self, [x, y]: [f64; 2]) -> Option<f64> {
        let placement = self.world.placement();
        let [mut u, mut v] = [x, y];
        let mut p: Vec3 = [0.0; 3];
        for _ in 0..60 {
            let (s, n) = self.world.nominal(u, v);
            let h = self.world.deviation_mm(u, v);
            p = placement.apply(std::array::from_fn(|i| s[i] + h * n[i]));
            let (dx, dy) = (x - p[0], y - p[1]);
            let r = &placement.rotation;
            (u, v) = (u + r[0][0] * dx + r[1][0] * dy, v + r[0][1] * dx + r[1][1] * dy);
            if dx.abs().max(dy.abs()) < 1e-10 {
                break;
            }
        }
        (u.abs() < 50.7 && v.abs() < 30.7).then_some(p[2])
    }

    /// Takes a picture: rows from the top, in mm. Some samples are lost to dust and dark spots.
    fn picture(&mut self) -> Vec<Option<f64>> {
        self.pictures += 1;
        let piston_mm = 0.137 * f64::from(self.pictures) - 0.4;
        let [columns, rows] = SIZE;
        let place = |i: usize, j: usize| [CORNER_MM[0] + i as f64 * PITCH_MM, CORNER_MM[1] + j as f64 * PITCH_MM];
        let lost = |i: usize, j: usize| {
            (i * 7919 + j * 104_729).is_multiple_of(41) || (i as f64 - 70.0).hypot(j as f64 - 30.0) < 2.5
        };
        let places = (0..rows).rev().flat_map(|j| (0..columns).map(move |i| (i, j)));
        let sample = |(i, j)| if lost(i, j) { None } else { self.height(place(i, j)).map(|z| z + piston_mm) };
        places.map(sample).collect()
    }
}

/// Writes a MetroPro file of the first header format, from the format's description alone.
fn metropro([columns, rows]: [usize; 2], pitch_mm: f64, heights_mm: &[Option<f64>]) -> Vec<u8> {
    let mut header = vec![0u8; 834];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    let half = |v: usize| u16::try_from(v).unwrap().to_be_bytes();
    put(0, &0x881b_036fu32.to_be_bytes());
    put(4, &1u16.to_be_bytes());
    put(6, &834u32.to_be_bytes());
    // A block of intensities of 3 by 2 precedes the phases.
    for (at, v) in [(52, 3), (54, 2), (56, 1), (68, columns), (70, rows)] {
        put(at, &half(v));
    }
    put(60, &12u32.to_be_bytes());
    put(72, &u32::try_from(4 * columns * rows).unwrap().to_be_bytes());
    let (scale, wavelength, obliquity) = (real(0.5), real(632.8e-9), real(1.0));
    for (at, v) in [(164, scale), (168, wavelength), (176, obliquity), (184, real(1e-3 * pitch_mm))] {
        put(at, &v.to_be_bytes());
    }
    // Resolution 0: 4096 steps a wave.
    let step_mm = 1e3 * f64::from(scale) * f64::from(wavelength) * f64::from(obliquity) / 4096.0;
    let mut bytes = [header, vec![0x5a; 12]].concat();
    for height in heights_mm {
        let raw = height.map_or(2_147_483_640, |z| (z / step_mm).round() as i32);
        bytes.extend(raw.to_be_bytes());
    }
    bytes
}

// ---- the cell -----------------------------------------------------------------------------------------------------------------------

/// Watches the outbox for plans and answers each with a map, as the operator of an interferometer does.
fn serve_maps(shop: PathBuf, world: World, over: Arc<AtomicBool>, taken: Arc<Mutex<u32>>) {
    let mut instrument = Interferometer { world, pictures: 0 };
    let mut answered = Vec::new();
    while !over.load(Ordering::Relaxed) {
        let plans = fs::read_dir(shop.join("out")).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        let open: Vec<String> = plans.filter(|n| !n.starts_with('.') && !n.contains(".done")).collect();
        for plan in open.into_iter().filter(|n| !n.contains('.')) {
            if answered.contains(&plan) {
                continue;
            }
            let Ok(text) = fs::read(shop.join("out").join(&plan).join("plan.json")) else { continue };
            let json: Value = serde_json::from_slice(&text).unwrap();
            let name = json["expected_back"]["file"].as_str().unwrap().replace('*', "dat");
            let bytes = metropro(SIZE, PITCH_MM, &instrument.picture());
            let draft = shop.join(format!("draft-{name}"));
            fs::write(&draft, bytes).unwrap();
            fs::rename(draft, shop.join("in").join(name)).unwrap();
            *taken.lock().unwrap() += 1;
            answered.push(plan);
        }
        std::thread::park_timeout(Duration::from_millis(5));
    }
}

/// Returns the shipped mirror, measured wherever the picture shows it. The start pose is searched for, because a
/// picture does not contain its position.
fn recipe() -> Recipe {
    let text = changed(
        "recipes/freeform-mirror.toml",
        &[
            (
                "pattern = \"grid\"\ncolumns = 60                # 1,800 points\nrows = 30\n",
                "pattern = \"free\"\npoints = 5000\n",
            ),
            ("edge_margin_mm = 0.5\n", ""),
            (
                "qualify = true              # touch the reference sphere first\nradius_tolerance_um = 2.0\n",
                "qualify = false\n",
            ),
            ("accuracy_nm = 0.5", "spacing_mm = 1.0"),
        ],
    );
    Recipe::parse(&root().join("recipes/freeform-mirror.toml"), &text).unwrap_or_else(|problems| panic!("{problems}"))
}

/// Returns a cell with a file-exchange measuring machine and a grinder on Modbus TCP.
fn cell(shop: &Path, port: u16) -> CellConfig {
    let (inbox, outbox) = (shop.join("in"), shop.join("out"));
    let wire = format!(
        "kind = \"file-exchange\"\noutbox = \"{}\"\ninbox = \"{}\"\nstable_for_s = 0.05\napart = true\n",
        outbox.display(),
        inbox.display()
    );
    let text = changed(
        "config/modbus-tcp.toml",
        &[
            ("kind = \"modbus-tcp\"\nhost = \"127.0.0.1\"\nport = 15021\nunit = 1\n", &wire),
            ("port = 15022", &format!("port = {port}")),
        ],
    );
    let (head, rest) = text.split_once("[cmm.registers]").unwrap();
    let rest = rest.split_once("[cmm.fixture]").unwrap().1;
    // The corner of the picture is the origin of its frame.
    let fixture = format!("\ntranslation_mm = [{}, {}, 0.0]", -CORNER_MM[0], -CORNER_MM[1]);
    let rest = rest.replacen("\ntranslation_mm = [0.0, 0.0, 0.0]", &fixture, 1);
    let text = format!("{head}[cmm.fixture]{rest}");
    CellConfig::parse(Path::new("cell.toml"), &text).unwrap_or_else(|problems| panic!("{problems}"))
}

struct Ran {
    ending: Ending,
    cycles: Vec<CycleRow>,
    said: Vec<String>,
    folder: PathBuf,
    world: World,
    pictures: u32,
    _home: tempfile::TempDir,
}

async fn run(seed: u64) -> Ran {
    let home = tempfile::tempdir().unwrap();
    let _kept = regrind_testutils::keep::KeepRunFolders(home.path().to_owned());
    let (shop, folder) = (home.path().join("shop"), home.path().join("run"));
    ["in", "out"].iter().for_each(|name| fs::create_dir_all(shop.join(name)).unwrap());
    let recipe = recipe();
    let mut spec = recipe.simulation.clone().unwrap().try_into::<WorldSpec>().unwrap();
    (spec.seed, spec.speed) = (seed, SPEED);
    (spec.cmm.translation_mm, spec.cmm.rotation_deg) = ([0.8, -1.1, 3.0], [0.7, -0.5, 1.2]);
    let world = World::new(spec).unwrap();
    let acting = Duration::from_millis(10);
    let options = MachineOptions { speed: SPEED, seed, lost_after_ms: 30_000, acting, ..MachineOptions::default() };
    let grinder = SimulatedMachine::new(Box::new(world.grinder()), 0x9, options);
    let serving = Serving::tcp("127.0.0.1:0", vec![(2, grinder)]).await.unwrap();
    let cell = cell(&shop, serving.local_addr().unwrap().port());
    let (task, plan) = setup::prepare(&recipe, &cell).unwrap();
    let (cmm, grinder) = setup::create_drivers(&recipe, &cell, "FFM", &folder, [7, 1]).unwrap();
    let journal: Box<dyn JournalSink> = Box::new(Journal::create(&folder, header("FFM")).unwrap());
    let (notices, mut shown) = mpsc::unbounded_channel();
    let actor = Actor { name: "test".into(), station: "here".into() };
    let poll = [Duration::from_millis(20); 2];
    let run = RunInputs {
        plan,
        task,
        journal,
        job: 7,
        actor,
        load_confirmed: true,
        poll_intervals: poll,
        notices,
        interrupted: None,
        executor: BlockingExecutor::Threads,
    };
    let (over, pictures) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(0)));
    let stand_in = {
        let (shop, world, over, pictures) = (shop.clone(), world.clone(), over.clone(), pictures.clone());
        std::thread::spawn(move || serve_maps(shop, world, over, pictures))
    };
    let (drive, _orders) = Drive::new(run, cmm, grinder).unwrap();
    let driving = tokio::spawn(drive.run());
    let (mut said, mut cycles) = (Vec::new(), Vec::new());
    let shows = async {
        while let Some(notice) = shown.recv().await {
            match notice {
                Notice::Finished { cycles: rows, .. } => cycles = rows,
                Notice::Progress { .. } | Notice::State { .. } => {}
                // A held cell waits for a person, and this test has no person.
                Notice::Alarm(alarm) if alarm.cleared_by != Role::Nobody => panic!("{}: {said:#?}", alarm.event),
                other => said.push(format!("{other:?}")),
            }
        }
    };
    let ended = tokio::time::timeout(PATIENCE, shows).await;
    over.store(true, Ordering::Relaxed);
    stand_in.join().unwrap();
    assert!(ended.is_ok(), "no end: {said:#?}");
    let ending = driving.await.unwrap();
    let pictures = *pictures.lock().unwrap();
    Ran { ending, cycles, said, folder, world, pictures, _home: home }
}

/// Returns the RMS of the true form error at the end, in µm. It leaves out the best-fit pose, which no measurement can
/// distinguish from a shift.
fn true_rms_um(world: &World) -> f64 {
    let places: Vec<[f64; 2]> =
        (0..40 * 30).map(|k| [f64::from(k % 40) * 2.5 - 48.75, f64::from(k / 40) * 2.0 - 29.0]).collect();
    let heights = world.deviations_mm(&places);
    let rows: Vec<Vector6<f64>> = places
        .iter()
        .map(|[x, y]| world.nominal(*x, *y))
        .map(|(s, n)| {
            let turn = [s[1] * n[2] - s[2] * n[1], s[2] * n[0] - s[0] * n[2], s[0] * n[1] - s[1] * n[0]];
            Vector6::new(n[0], n[1], n[2], turn[0], turn[1], turn[2])
        })
        .collect();
    let gram: Matrix6<f64> = rows.iter().map(|row| row * row.transpose()).sum();
    let right: Vector6<f64> = rows.iter().zip(&heights).map(|(row, h)| row * *h).sum();
    let twist = gram.lu().solve(&right).expect("the part holds its pose");
    let left = rows.iter().zip(&heights).map(|(row, h)| (h - row.dot(&twist)).powi(2));
    1e3 * (left.sum::<f64>() / heights.len() as f64).sqrt()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn interferometer_maps_close_the_loop() {
    let seed = 9;
    let ran = run(seed).await;
    for row in &ran.cycles {
        println!(
            "seed {seed}, cycle {}: PV {:.2} um, RMS {:.3} um, {} points, {} outliers",
            row.cycle, row.pv_um, row.rms_um, row.points, row.outliers
        );
    }
    let true_um = true_rms_um(&ran.world);
    println!("{:?}; the truth: {true_um:.3} um rms; {} pictures", ran.ending, ran.pictures);
    assert!(matches!(ran.ending, Ending::Accepted { .. }), "{:?}\n{:#?}", ran.ending, ran.said);
    assert!(ran.cycles.len() >= 2 && ran.pictures as usize == ran.cycles.len(), "{:?}", ran.cycles);
    let (first, last) = (&ran.cycles[0], ran.cycles.last().unwrap());
    assert!(first.rms_um > 4.0 * last.rms_um && last.rms_um < 1.0 && first.points > 5000, "{:?}", ran.cycles);
    // The accepted figures agree with the true surface.
    assert!(true_um < 1.0 && (true_um / last.rms_um - 1.0).abs() < 0.2, "{true_um}");
    // The record contains the measurement and the results computed from it.
    let cycle = ran.folder.join(format!("cycle-{}", last.cycle));
    let X3pFile::Map(map) = read_x3p(cycle.join("error_map.x3p")).unwrap() else { panic!("a map") };
    assert!(map.heights.grid.columns > 90 && map.measured_count() > 5000 && map.rms_mm() < 1e-3);
    assert!(fs::read_to_string(cycle.join("registration.json")).unwrap().contains("\"weak_directions\": []"));
    let figures: Value = serde_json::from_slice(&fs::read(cycle.join("figures.json")).unwrap()).unwrap();
    let rows = figures["figures"].as_array().unwrap();
    let named = |name: &str| rows.iter().find(|row| row["name"] == name).unwrap()["value"].as_f64().unwrap();
    assert!(
        (named("RMS of the points") / last.rms_um - 1.0).abs() < 1e-9
            && (named("PV of the points") / last.pv_um - 1.0).abs() < 1e-9
    );
    assert!(named("PVr") > 0.0 && named("coverage") > 95.0 && named("slope RMS") > 0.0, "{figures}");
    assert!(figures["missing"].as_array().unwrap().is_empty(), "{figures}");
    for name in ["error_map.csv", "error_map.svg", "error_map.png", "deviations.ply"] {
        assert!(cycle.join(name).is_file(), "{name}");
    }
    // The report verifies the record and shows these results.
    let report = fs::read_to_string(
        regrind::report::write_run_report(&ran.folder, &regrind::report::ReportOptions::default()).unwrap(),
    )
    .unwrap();
    let notation = figures["iso_10110_5"]["notation"].as_str().unwrap();
    println!("{notation}");
    for words in ["<td>PVr</td>", "highest (stock left)", "36 Legendre terms", &notation.replace('<', "&lt;")] {
        assert!(report.contains(words), "{words}");
    }
}

// ---- the folders --------------------------------------------------------------------------------------------------------------------

/// Returns the metadata of a map in an X3P file.
fn record() -> MapRecord {
    MapRecord {
        date: "2026-03-01T12:00:00Z".into(),
        creator: "a test".into(),
        instrument: "interferometer".into(),
        comment: String::new(),
    }
}

/// Returns the maps of a small surface in each format, with one sample that was not measured.
fn small_maps(folder: &Path) -> Vec<(PathBuf, HeightMap)> {
    let sample = |k: usize| (k != 7).then_some(1e-3 * (k as f64 - 5.0));
    let map = HeightMap::new(
        Path::new("map"),
        Grid { columns: 5, rows: 4, first_mm: [0.0; 2], spacing_mm: [0.25; 2] },
        (0..20).map(sample),
    )
    .unwrap();
    let [x3p, sdf, dat] = ["x3p", "sdf", "dat"].map(|end| folder.join(format!("map.{end}")));
    write_x3p(&x3p, &map, &record()).unwrap();
    let heights = |k: usize| sample(k).map_or("BAD".to_owned(), |z| format!("{z}"));
    let rows: Vec<String> = (0..4).map(|j| (0..5).map(|i| heights(5 * j + i)).collect::<Vec<_>>().join(" ")).collect();
    let text = format!(
        "aISO-1.0\nManufacID = none\nNumPoints = 5\nNumProfiles = 4\nXscale = 2.5e-4\nYscale = 2.5e-4\nZscale = 1e-3\n\
         Zresolution = -1\nCompression = 0\nDataType = 7\nCheckType = 0\n*\n{}\n*\n",
        rows.join("\n")
    );
    fs::write(&sdf, text).unwrap();
    let from_top: Vec<Option<f64>> = (0..4).rev().flat_map(|j| (0..5).map(move |i| sample(5 * j + i))).collect();
    fs::write(&dat, metropro([5, 4], 0.25, &from_top)).unwrap();
    [x3p, sdf, dat].into_iter().map(|path| (path, map.clone())).collect()
}

#[test]
fn height_map_formats_give_contact_points() {
    let home = tempfile::tempdir().unwrap();
    for (path, map) in small_maps(home.path()) {
        let points = read_measured(&path).unwrap();
        assert_eq!(points.len(), 19);
        for (found, expected) in points.iter().zip(map.points()) {
            assert!((found - expected).norm() < 1e-7, "{}: {found} not {expected}", path.display());
        }
        let told = formats::read_nominal(&path).unwrap_err();
        assert!(matches!(told, FormatError::WrongKind { .. }), "{told}");
        let (taken, said) = exchanged(&path, Content::default());
        let taken = taken.unwrap_or_else(|| panic!("{said:#?}"));
        assert_eq!((taken.points.len(), taken.coordinates), (19, Coordinates::Contacts));
        let content = Content { coordinates: Some(Said::Centres), ..Content::default() };
        let (taken, said) = exchanged(&path, content);
        assert!(taken.is_none() && said.join("\n").contains("centres in the cell file"));
    }
}

/// Puts a map into the folders of a measuring machine as the answer to a plan. Returns the measurement, if there is
/// one, and the messages.
fn exchanged(map: &Path, content: Content) -> (Option<Measurement>, Vec<String>) {
    let home = tempfile::tempdir().unwrap();
    let [inbox, outbox] = ["in", "out"].map(|name| home.path().join(name));
    [&inbox, &outbox].iter().for_each(|folder| fs::create_dir(folder).unwrap());
    let mut folders = CmmFolders::new(CmmExchange {
        stable_for: Duration::ZERO,
        content,
        free_count: true,
        ..CmmExchange::new("P", &outbox, &inbox)
    });
    let plan = Plan {
        targets: Vec::new(),
        probe_radius_mm: 1.5,
        approach_mm: 0.0,
        search_mm: 0.0,
        speed_mm_s: 0.0,
        safe_height_mm: 0.0,
        careful_start: None,
    };
    let plan_identity = plan.identity();
    let job = Job { job: 1, cycle: 0, digest: digest(&[plan_identity]) };
    folders.publish(job, 1, &MeasureOrder { plan, plan_identity }, &Permit::new()).unwrap();
    fs::copy(map, inbox.join("P_c0").with_extension(map.extension().unwrap())).unwrap();
    let look = folders.poll(Duration::from_secs(1), job).unwrap();
    (look.answer, look.notes)
}

#[test]
fn height_map_without_scale_refused() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("map.dat");
    fs::write(&path, metropro([5, 4], 0.0, &[Some(1e-4); 20])).unwrap();
    let told = read_measured(&path).unwrap_err();
    assert!(matches!(told, FormatError::NoLateralScale { .. }), "{told}");
    let (taken, said) = exchanged(&path, Content::default());
    assert!(taken.is_none() && said.join("\n").contains("no lateral scale"), "{said:?}");
}

// ---- the command line ---------------------------------------------------------------------------------------------------------------

#[test]
fn register_accepts_height_map() {
    let home = tempfile::tempdir().unwrap();
    let shape = FreeForm::default();
    let nominal: Vec<String> =
        shape.grid(60.0, 40.0, 121, 81).iter().map(|p| format!("{},{},{}\n", p[0], p[1], p[2])).collect();
    fs::write(home.path().join("nominal.csv"), nominal.concat()).unwrap();
    // The instrument's frame is shifted against the part's.
    let [dx, dy, dz] = [0.75, -0.5, 12.5];
    let height = |k: usize| {
        let [x, y] = [f64::from((k % 100) as u16) * 0.5 - 25.0, f64::from((k / 100) as u16) * 0.5 - 15.0];
        (k % 13 != 5).then(|| shape.height(x - dx, y - dy) + dz)
    };
    let map = HeightMap::new(
        Path::new("map"),
        Grid { columns: 100, rows: 60, first_mm: [-25.0, -15.0], spacing_mm: [0.5; 2] },
        (0..6000).map(height),
    )
    .unwrap();
    write_x3p(&home.path().join("map.x3p"), &map, &record()).unwrap();
    let register = |more: &[&str]| {
        let files = ["register", "--nominal", "nominal.csv", "--measured", "map.x3p", "--out", "out"];
        program::run(&[&files, more].concat(), home.path())
    };
    let (code, _, told) = register(&["--method", "contact"]);
    assert_eq!(code, 0, "{told}");
    let text = fs::read_to_string(home.path().join("out/registration.json")).unwrap();
    let json: Value = serde_json::from_str(&text).unwrap();
    let rows: [[f64; 4]; 4] = serde_json::from_value(json["cmm_from_model"].clone()).unwrap();
    let pose = Pose::from_rows(rows).unwrap();
    println!("{:?}, rms {} mm", pose.translation_mm, json["rms_mm"]);
    let truth: [f64; 3] = [dx, dy, dz];
    assert!((0..3).all(|k| (pose.translation_mm[k] - truth[k]).abs() < 1e-3) && pose.angle_rad() < 1e-4, "{pose:?}");
    assert_eq!(json["points"], map.measured_count());
    // No probe radius must be subtracted, because a map has no probe ball.
    let (code, _, told) = register(&["--probe-radius", "1.5"]);
    assert_eq!(code, 2, "{told}");
    assert!(told.contains("--method contact"), "{told}");
}
