//! Machines that consist of two folders and a person: which files are accepted, which are ignored, and that nothing is
//! handed over twice.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant, SystemTime};

use regrind::device::file_exchange::{
    CmmExchange, CmmFolders, ConfirmedStep, Exchange, ExchangeError, ExchangeMachine, GrindOrder, GrinderExchange,
    GrinderFolders, HandOver, HandOverStatus, MeasureOrder, Pattern, Permit, PollResult, StationFiles, Stations,
};
use regrind::device::{
    Answer, Cmm, Coordinates, CorrectionMap, DeviceError, Grinder, Identified, Interrupt, Job, Machine, MachineKind,
    MachineState, Measurement, OperatorConfirmation, Outcome, Plan, PlanTarget, Reconciled, TargetKind, TouchStatus,
    digest,
};
use regrind::formats::FormatError;
use regrind::formats::operator_step::OperatorStep;
use regrind::geometry::Grid;
use tokio::sync::oneshot;

use crate::toy::pass;

/// Modification time of the next file, in seconds.
static WRITTEN_S: AtomicU64 = AtomicU64::new(1_700_000_000);

/// Two folders of a machine.
struct Shop {
    _home: tempfile::TempDir,
    outbox: PathBuf,
    inbox: PathBuf,
}

impl Shop {
    fn new() -> Self {
        let home = tempfile::tempdir().unwrap();
        let (outbox, inbox) = (home.path().join("out"), home.path().join("in"));
        fs::create_dir_all(&outbox).unwrap();
        fs::create_dir_all(&inbox).unwrap();
        Self { _home: home, outbox, inbox }
    }

    /// Returns settings with which a poll reports its findings, however busy the computer is.
    fn cmm(&self) -> CmmExchange {
        let read_within = Duration::from_secs(300);
        CmmExchange { read_timeout: read_within, ..CmmExchange::new("SN 7", &self.outbox, &self.inbox) }
    }

    fn grinder(&self, stable_for: Duration) -> GrinderFolders {
        let (outbox, inbox) = (self.outbox.clone(), self.inbox.clone());
        GrinderFolders::new(GrinderExchange {
            part: "SN 7".into(),
            outbox,
            inbox,
            run_folder: PathBuf::new(),
            stable_for,
        })
    }

    /// Writes a file. Each is a second newer than the one before, independent of the resolution of the disk's clock.
    fn put(&self, name: &str, text: &str) {
        let path = self.inbox.join(name);
        fs::write(&path, text).unwrap();
        let written = SystemTime::UNIX_EPOCH + Duration::from_secs(WRITTEN_S.fetch_add(1, Ordering::Relaxed));
        File::options().write(true).open(&path).unwrap().set_modified(written).unwrap();
    }

    /// Returns the names in the outbox.
    fn handed(&self) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(&self.outbox)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }
}

fn plan(count: u32) -> Plan {
    let target = |index| PlanTarget {
        index: 10 + index,
        kind: TargetKind::Part,
        point_mm: [f64::from(index), 0.25, -1e-7],
        normal: [0.0, 0.6, 0.8],
    };
    Plan {
        targets: (0..count).map(target).collect(),
        probe_radius_mm: 1.5,
        approach_mm: 2.0,
        search_mm: 1.0,
        speed_mm_s: 5.0,
        safe_height_mm: 50.0,
        careful_start: None,
    }
}

fn order(count: u32) -> (MeasureOrder, u32) {
    let plan = plan(count);
    let plan_identity = plan.identity();
    (MeasureOrder { plan, plan_identity }, digest(&[plan_identity]))
}

/// Measuring machine with a plan of three targets in its folders, job 3 cycle 2, and its clock.
struct Bench {
    folders: CmmFolders,
    job: Job,
    now_s: u64,
}

impl Bench {
    fn new(settings: CmmExchange) -> Self {
        let mut folders = CmmFolders::new(settings);
        let (order, digest) = order(3);
        let job = Job { job: 3, cycle: 2, digest };
        folders.publish(job, 1, &order, &Permit::new()).unwrap();
        Self { folders, job, now_s: 0 }
    }

    fn poll(&mut self) -> PollResult<Measurement> {
        self.now_s += 1;
        self.folders.poll(Duration::from_secs(self.now_s), self.job).unwrap()
    }

    /// Polls until all files have settled.
    fn settled(&mut self) -> PollResult<Measurement> {
        for _ in 0..2 {
            self.poll();
        }
        self.poll()
    }

    fn refused(&mut self, pieces: &[&str]) {
        let look = self.settled();
        assert!(look.answer.is_none(), "{pieces:?}");
        assert_says(&look, pieces);
    }
}

/// Asserts that one note of a poll contains all these pieces.
fn assert_says<A>(look: &PollResult<A>, pieces: &[&str]) {
    let is_said = look.notes.iter().any(|note| pieces.iter().all(|piece| note.contains(piece)));
    assert!(is_said, "{:#?}\nwithout {pieces:?}", look.notes);
}

const CENTRES: &str = "# coordinates: centres\n";
const THREE: &str = "x,y,z\n1,2,3\n4,5,6\n7,8,9.125\n";

fn three() -> String {
    format!("{CENTRES}{THREE}")
}

#[test]
fn exchange_plan_files_are_exact() {
    let shop = Shop::new();
    let bench = Bench::new(shop.cmm());
    assert_eq!(shop.handed(), ["SN_7_j3_c2"]);
    let folder = shop.outbox.join("SN_7_j3_c2");
    let text = fs::read_to_string(folder.join("plan.csv")).unwrap();
    let identity: String = plan(3).identity().iter().map(|b| format!("{b:02x}")).collect();
    assert!(
        text.contains(&format!("# plan: {identity}\n")) && text.contains("\nindex,x,y,z,nx,ny,nz,what\n"),
        "{text}"
    );
    let rows: Vec<Vec<f64>> = text
        .lines()
        .filter(|l| l.starts_with(|c: char| c.is_ascii_digit()))
        .map(|l| l.split(',').map(|n| n.parse().unwrap()).collect())
        .collect();
    assert_eq!(rows[2], [12.0, 2.0, 0.25, -1e-7, 0.0, 0.6, 0.8, 1.0]);
    let json: serde_json::Value = serde_json::from_slice(&fs::read(folder.join("plan.json")).unwrap()).unwrap();
    assert_eq!((&json["plan"], &json["cycle"], &json["units"]), (&identity.into(), &2.into(), &"mm".into()));
    assert_eq!(json["expected_back"]["file"], "SN_7_c2.*");
    drop(bench);
}

#[test]
fn result_accepted_after_settling() {
    let shop = Shop::new();
    let mut bench = Bench::new(shop.cmm());
    assert_says(&bench.poll(), &["waiting for SN_7_c2.* in"]);
    shop.put("SN_7_c2.csv", "# coordinates: centres\nx,y,z\n1,2,3\n");
    assert!(bench.poll().answer.is_none());
    // The file grows during the polls: the settling time begins again.
    shop.put("SN_7_c2.csv", "# coordinates: centres\nx,y,z\n1,2,3\n4,5,6\n7,8,9.1");
    let look = bench.poll();
    assert!(look.answer.is_none());
    assert_says(&look, &["still changing"]);
    // The last line has three numbers, but it is incomplete.
    bench.refused(&["line 5", "`7,8,9.1`"]);
    shop.put("SN_7_c2.csv", &three());
    assert!(bench.poll().answer.is_none());
    assert!(bench.poll().answer.is_none());
    let found = bench.poll().answer.unwrap();
    assert_eq!(found.points.iter().map(|p| p.index).collect::<Vec<_>>(), [10, 11, 12]);
    assert_eq!((found.points[2].position_mm, found.coordinates), ([7.0, 8.0, 9.125], Coordinates::Centres));
    assert_eq!((found.job, found.cycle, found.plan_identity), (3, 2, plan(3).identity()));
    // A second poll returns the same.
    assert_eq!(bench.poll().answer.unwrap(), found);
}

/// Returns the height of the part above the nominal surface at a point of a plan, in mm.
fn proud_mm(number: usize) -> f64 {
    0.004 * number as f64
}

/// Returns the result file of a machine that runs DMIS: every statement of the program, and every point touched by a
/// ball of 1.5 mm, a little above its target.
fn dmis_result(program: &str) -> String {
    // A `$` at the end of a line continues it on the next.
    let whole = program.replace("$\n", "");
    let mut output = String::from("UNITS/MM,ANGDEC\n");
    let mut points = std::collections::BTreeMap::new();
    for line in whole.lines() {
        if line.starts_with("TEXT/OUTFIL") || line.starts_with("PRCOMP") {
            output += &format!("{line}\n");
        }
        let nominal = line.strip_prefix("F(").and_then(|rest| rest.split_once(")=FEAT/POINT,CART,"));
        if let Some((name, numbers)) = nominal {
            let [x, y, z, i, j, k]: [f64; 6] =
                numbers.split(',').map(|n| n.parse().unwrap()).collect::<Vec<_>>().try_into().unwrap();
            let away = 1.5 + proud_mm(points.len());
            points.insert(name.to_owned(), ([x + away * i, y + away * j, z + away * k], [i, j, k]));
        }
        if let Some(name) = line.strip_prefix("OUTPUT/FA(").and_then(|rest| rest.strip_suffix(')')) {
            let ([x, y, z], [i, j, k]) = points[name];
            output += &format!("FA({name})=FEAT/POINT,CART,{x:.6},{y:.6},{z:.6},$\n{i:.6},{j:.6},{k:.6}\n");
        }
    }
    output + "ENDFIL\n"
}

#[test]
fn dmis_hand_over_and_result() {
    use regrind::formats::result::{Content, Coordinates as Said};
    let shop = Shop::new();
    let content = Content { coordinates: Some(Said::Centres), ..Content::default() };
    let settings = CmmExchange { dmis_sensor: Some("PROBE6".into()), content, ..shop.cmm() };
    let mut bench = Bench::new(settings);
    let program = fs::read_to_string(shop.outbox.join("SN_7_j3_c2/plan.dmi")).unwrap();
    let output = dmis_result(&program);
    // A result of another plan, cycle or part is not accepted, whatever its name.
    for (from, to, expected) in [
        ("'cycle: 2'", "'cycle: 1'", &["cycle 1, not 2", "ignored"][..]),
        ("'part: SN 7'", "'part: SN 8'", &["part SN 8, not SN 7", "ignored"]),
        ("PRCOMP/OFF", "PRCOMP/ON", &["contacts"]),
        ("ENDFIL", "", &["ENDFIL"]),
    ] {
        assert!(output.contains(from), "{output}");
        shop.put("SN_7_c2.res", &output.replace(from, to));
        bench.refused(expected);
    }
    shop.put("SN_7_c2.res", &output);
    let found = bench.settled().answer.unwrap();
    assert_eq!(found.points.iter().map(|p| p.index).collect::<Vec<_>>(), [10, 11, 12]);
    assert_eq!((found.coordinates, found.plan_identity), (Coordinates::Centres, plan(3).identity()));
    for (number, (point, target)) in found.points.iter().zip(plan(3).targets).enumerate() {
        let away = 1.5 + proud_mm(number);
        for k in 0..3 {
            assert!((point.position_mm[k] - target.point_mm[k] - away * target.normal[k]).abs() < 1e-6, "{point:?}");
        }
    }
}

#[test]
fn qif_result_identified_by_content() {
    let shop = Shop::new();
    let mut bench = Bench::new(shop.cmm());
    let identity: String = plan(3).identity().iter().map(|b| format!("{b:02x}")).collect();
    let document = |cycle: u32, factor: &str| {
        format!(
            "<?xml version=\"1.0\"?>\n<QIFDocument xmlns=\"http://qifstandards.org/xsd/qif3\" versionQIF=\"3.0.0\" idMax=\"9\">\n\
             <Attributes n=\"3\"><AttributeStr name=\"regrind part\" value=\"SN 7\"/>\
             <AttributeStr name=\"regrind cycle\" value=\"{cycle}\"/><AttributeStr name=\"regrind plan\" value=\"{identity}\"/></Attributes>\n\
             <FileUnits><PrimaryUnits><LinearUnit><SIUnitName>meter</SIUnitName><UnitName>mm</UnitName>\
             <UnitConversion><Factor>{factor}</Factor></UnitConversion></LinearUnit></PrimaryUnits></FileUnits>\n\
             <MeasuredPointSet count=\"3\" id=\"5\"><Points>1 2 3\n4 5 6\n7 8 9.125</Points>\
             <Compensated>false</Compensated></MeasuredPointSet>\n</QIFDocument>\n"
        )
    };
    shop.put("export.qif", &document(1, "0.001"));
    bench.refused(&["export.qif"]);
    // The unit is the one in the file.
    shop.put("export.qif", &document(2, "0.0254"));
    let found = bench.settled().answer.unwrap();
    assert_eq!(found.points.iter().map(|p| p.index).collect::<Vec<_>>(), [10, 11, 12]);
    let expected = [7.0, 8.0, 9.125].map(|inches| 25.4 * inches);
    assert!((0..3).all(|k| (found.points[2].position_mm[k] - expected[k]).abs() < 1e-9), "{:?}", found.points[2]);
    assert_eq!(found.coordinates, Coordinates::Centres);
}

#[test]
fn result_of_other_part_or_cycle_ignored() {
    let shop = Shop::new();
    shop.put("SN_7_c2.csv", &three());
    let mut bench = Bench::new(shop.cmm());
    bench.refused(&["SN_7_c2.csv", "before the plan", "ignored"]);
    for (text, expected) in [
        (format!("# part: SN 8\n{}", three()), &["part SN 8, not SN 7", "ignored"][..]),
        (format!("# cycle: 1\n{}", three()), &["cycle 1, not 2", "ignored"]),
        (format!("# plan: {}\n{}", "0".repeat(64), three()), &["another plan", "ignored"]),
        (format!("# cycle: second\n{}", three()), &["`cycle` is `second`"]),
    ] {
        shop.put("SN_7_c2.csv", &text);
        bench.refused(expected);
    }
    fs::remove_file(shop.inbox.join("SN_7_c2.csv")).unwrap();
    shop.put("notes.txt", &three());
    bench.refused(&["notes.txt", "this job", "SN_7_c2.*", "ignored"]);
    // A file that identifies its part and cycle can have any name.
    shop.put("export 0815.txt", &format!("# part: SN 7\n# cycle: 2\n{}", three()));
    assert!(bench.settled().answer.is_some());
}

#[test]
fn result_errors_include_remedy() {
    let shop = Shop::new();
    let mut bench = Bench::new(shop.cmm());
    let with = |rows: &str| format!("{CENTRES}{rows}");
    for (text, expected) in [
        (with("1,2,3\n4,5,6\n"), &["2 points", "3 targets"][..]),
        (with("1,2,3\n4,NaN,6\n7,8,9\n"), &["line 3, column 2", "finite", "`NaN`"]),
        (with("1,2,3\n4,5,6\n7,8\n"), &["line 4", "3 columns"]),
        (
            with("1,234;5,678;9,012\n1,234;5,678;9,012\n1,234;5,678;9,012\n"),
            &["line 2, column 1", "comma of `1,234`", "thousands"],
        ),
        (with("1,5;2;3\n4.5;5;6\n7;8;9\n"), &["line 3, column 1", "decimal comma", "`4.5`"]),
        (THREE.to_owned(), &["# coordinates: centres", "# coordinates: contacts"]),
        (format!("# units: inch\n{}", three()), &["unit: inch", "mm in the cell file"]),
        (format!("# probe radius mm: 1.49\n{}", three()), &["probe radius", "1.49 mm", "1.5 mm"]),
        (with("index,x,y,z\n10,1,2,3\n99,4,5,6\n"), &["index `99`", "target"]),
        (with("index,x,y,z\n10,1,2,3\n10,4,5,6\n"), &["index `10`", "twice"]),
        (String::new(), &["line 1", "nothing"]),
    ] {
        shop.put("SN_7_c2.csv", &text);
        bench.refused(expected);
    }
    // Targets without a row have a known result: they were not found.
    shop.put("SN_7_c2.csv", &with("index,x,y,z\n12,1,2,3\n10,4,5,6\n"));
    let found = bench.settled().answer.unwrap();
    let status: Vec<TouchStatus> = found.points.iter().map(|p| p.status).collect();
    assert_eq!(status, [TouchStatus::Touched, TouchStatus::NotFound, TouchStatus::Touched]);
    assert_eq!(found.points[2].position_mm, [1.0, 2.0, 3.0]);
}

#[test]
fn two_matching_files_refused() {
    let shop = Shop::new();
    let mut bench = Bench::new(shop.cmm());
    shop.put("SN_7_c2.csv", &three());
    shop.put("SN_7_c2.txt", &three());
    bench.refused(&["2 files", "`SN_7_c2.*`", "SN_7_c2.csv", "SN_7_c2.txt"]);
    fs::remove_file(shop.inbox.join("SN_7_c2.txt")).unwrap();
    assert!(bench.settled().answer.is_some());
}

#[test]
fn cell_file_completes_result_content() {
    use regrind::formats::result::{Content, Coordinates as Said, DecimalMark};
    let shop = Shop::new();
    let content = Content {
        coordinates: Some(Said::Contacts),
        decimal: DecimalMark::Comma,
        unit: regrind::formats::Unit::Inch,
        height_unit: None,
        sample_spacing_mm: None,
        columns: None,
    };
    let mut bench = Bench::new(CmmExchange { content, ..shop.cmm() });
    shop.put("SN_7_c2.csv", &three());
    bench.refused(&["coordinates: centres", "contacts in the cell"]);
    shop.put("SN_7_c2.csv", "1,000;2;3\n1.000,5;5;6\n7;8;9\n");
    let found = bench.settled().answer.unwrap();
    assert_eq!(found.coordinates, Coordinates::Contacts);
    assert_eq!((found.points[0].position_mm[0], found.points[1].position_mm[0]), (25.4, 25.4 * 1000.5));
}

#[test]
fn hand_over_once_per_job_and_cycle() {
    let shop = Shop::new();
    let mut bench = Bench::new(shop.cmm());
    let (order, digest) = order(3);
    let job = bench.job;
    let again = |folders: &mut CmmFolders| folders.publish(job, 2, &order, &Permit::new());
    let refused = again(&mut bench.folders);
    assert!(matches!(refused, Err(ExchangeError::HandedOver { job: 3, cycle: 2, .. })), "{refused:?}");
    shop.put("SN_7_c2.csv", &three());
    assert!(bench.settled().answer.is_some());
    bench.folders.mark(bench.job, HandOverStatus::Closed).unwrap();
    assert_eq!(shop.handed(), ["SN_7_j3_c2.done"]);
    // Nor does another process accept it, nor after it was acknowledged.
    let mut other = CmmFolders::new(shop.cmm());
    let refused = again(&mut other);
    assert!(matches!(refused, Err(ExchangeError::HandedOver { job: 3, cycle: 2, .. })), "{refused:?}");
    let handed = other.open().unwrap();
    assert_eq!((handed.len(), handed[0].sequence, handed[0].status), (1, 1, HandOverStatus::Closed));
    let next = Job { job: 3, cycle: 3, digest };
    other.publish(next, 2, &order, &Permit::new()).unwrap();
    let mut bench = Bench { folders: other, job: next, now_s: 0 };
    shop.put("SN_7_c3.csv", &three());
    bench.refused(&["SN_7_c3.csv", "result of job 3 cycle 2"]);
}

#[test]
fn restart_finds_open_hand_over() {
    let shop = Shop::new();
    let bench = Bench::new(shop.cmm());
    let job = bench.job;
    drop(bench);
    let mut bench = Bench { folders: CmmFolders::new(shop.cmm()), job, now_s: 0 };
    shop.put("SN_7_c2.csv", &three());
    assert_eq!(bench.settled().answer.unwrap().points.len(), 3);
    bench.folders.mark(job, HandOverStatus::Held).unwrap();
    assert_eq!(shop.handed(), ["SN_7_j3_c2.held"]);
    bench.folders.mark(job, HandOverStatus::Open).unwrap();
    fs::rename(shop.outbox.join("SN_7_j3_c2"), shop.outbox.join("mine")).unwrap();
    let error = bench.folders.open().unwrap_err();
    assert!(
        matches!(
            &error,
            ExchangeError::Format(FormatError::Unexpected { place, found, .. }) if place == "name" && found == "mine"
        ),
        "{error}"
    );
}

// ---- stations ------------------------------------------------------------------------------------------------------------------

/// Positions of four reference points and three points of the part, in mm.
const REFERENCE: [[f64; 3]; 4] = [[0.0, 0.0, 0.0], [1000.0, 0.0, 10.0], [30.0, 700.0, 0.0], [900.0, 800.0, 300.0]];
const NOMINAL: &str = "coords: opt_global\nprimary:\n  left: [[0, 0, 0], [['CODE14', [1, 2, 3]]]] # lower\n  \
    right: [1000, 0, 10]\n  upper: [30, 700, 0]\n  lower: [900, 800, 300]\nother:\n  a: [1, 2, 3]\n";

/// Returns the coordinates that a station measures, rotated by 90 degrees about z and shifted.
fn seen(p: [f64; 3], station: usize) -> [f64; 3] {
    let s = station as f64;
    [p[1] + 100.0 * s, -p[0] + 5.0, p[2] - 3.0 * s]
}

fn references(order: [usize; 4], station: usize) -> String {
    let rows = order.map(|k| seen(REFERENCE[k], station).map(|c| c.to_string()));
    format!("primary:\n{}", rows.map(|r| format!("- - {}\n  - {}\n  - {}\n", r[0], r[1], r[2])).concat())
}

fn station_shop(shop: &Shop) -> CmmExchange {
    let nominal = shop.outbox.with_file_name("reference.yaml");
    fs::write(&nominal, NOMINAL).unwrap();
    let files = vec![StationFiles { points: Pattern::new("P_*.txt"), references: Pattern::new("ref_*.yaml") }];
    let stations = Stations { files, nominal, group: Some("primary".into()), limit_mm: 0.1 };
    CmmExchange { stations: Some(stations), free_count: true, min_points: 4, ..shop.cmm() }
}

fn points(station: usize) -> String {
    let rows = [[10.0, 20.0, 30.0], [40.0, 50.0, 61.0]].map(|p| seen(p, station).map(|c| c.to_string()).join("\t"));
    format!("{CENTRES}{}\n{}\n", rows[0], rows[1])
}

#[test]
fn stations_merge_by_reference_points() {
    let shop = Shop::new();
    let mut bench = Bench::new(station_shop(&shop));
    bench.refused(&["0 of 1", "first station"]);
    shop.put("P_1.txt", &points(1));
    bench.refused(&["0 of 1", "first station"]);
    shop.put("ref_1.yaml", &references([0, 1, 2, 3], 1));
    shop.put("ref_9.yaml", &references([0, 1, 2, 3], 9));
    bench.refused(&["2 points", "1 stations", "at least 4 points"]);
    shop.put("P_2.txt", &points(2));
    shop.put("ref_2.yaml", &references([0, 2, 1, 3], 2));
    bench.refused(&["station 2 (ref_2.yaml)", "reference point right"]);
    assert_says(&bench.poll(), &["right and upper", "swapped"]);
    shop.put("ref_2.yaml", &references([0, 1, 2, 3], 2));
    let look = bench.settled();
    assert_says(&look, &["ignored", "no station", "ref_9.yaml"]);
    assert_says(&look, &["station 1 (ref_1.yaml)", "0.000 mm rms", "left 0.000, right 0.000"]);
    let found = look.answer.unwrap();
    for (k, expected) in [[10.0, 20.0, 30.0], [40.0, 50.0, 61.0]].iter().cycle().take(4).enumerate() {
        let at = found.points[k].position_mm;
        assert!(at.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{at:?} not {expected:?}");
    }
}

// ---- the grinder -----------------------------------------------------------------------------------------------------------------

fn map() -> CorrectionMap {
    CorrectionMap {
        grid: Grid { columns: 3, rows: 2, first_mm: [-1.0, 5.0], spacing_mm: [0.5, 2.0] },
        values_mm: vec![0.0, 1e-4, -2e-4, 0.0, 3e-3, 0.25],
        part_identity: [7; 32],
    }
}

#[test]
fn pass_confirmed_by_map_identity() {
    let shop = Shop::new();
    let mut grinder = shop.grinder(Duration::from_secs(2));
    let map_identity = map().identity();
    let job = Job { job: 3, cycle: 2, digest: digest(&[map_identity, pass().identity()]) };
    shop.put("done.json", "{}");
    // The confirmation of an earlier pass is no news.
    shop.put("started.json", &format!("{{\"map\": \"{}\", \"job\": 3, \"cycle\": 1}}", "0a".repeat(32)));
    grinder.publish(job, 4, &GrindOrder { map: map(), pass: pass(), map_identity }, &Permit::new()).unwrap();
    let folder = shop.outbox.join("SN_7_j3_c2");
    let csv = fs::read_to_string(folder.join("correction.csv")).unwrap();
    assert!(csv.contains("positive value leaves") && csv.ends_with("-1,7,0\n-0.5,7,0.003\n0,7,0.25\n"), "{csv}");
    let mut now = 0;
    let mut settled = |grinder: &mut GrinderFolders| {
        now += 10;
        grinder.poll(Duration::from_secs(now), job).unwrap();
        grinder.poll(Duration::from_secs(now + 2), job).unwrap()
    };
    let look = settled(&mut grinder);
    assert_says(&look, &["done.json", "before the map", "ignored"]);
    assert!(!look.start_confirmed && !look.notes.iter().any(|note| note.contains("started.json was")), "{look:?}");
    assert_says(&look, &["regrind confirm started"]);
    shop.put("started.json", r#"{"map": "0123456789abcdef"}"#);
    let look = settled(&mut grinder);
    assert!(!look.start_confirmed);
    assert_says(&look, &["map `0123456789abcdef`", "but map "]);
    fs::copy(folder.join("started.json"), shop.inbox.join("started.json")).unwrap();
    let look = settled(&mut grinder);
    assert!(look.start_confirmed && look.answer.is_none());
    assert_says(&look, &["regrind confirm done"]);
    let done = fs::read_to_string(folder.join("done.json")).unwrap();
    shop.put("done.json", &done.replace("\"cycle\": 2", "\"cycle\": 1"));
    assert_says(&settled(&mut grinder), &["done.json", "job 3 cycle 1", "job 3 cycle 2"]);
    shop.put("done.json", "{\"map\"");
    assert_says(&settled(&mut grinder), &["expected JSON"]);
    fs::copy(folder.join("done.json"), shop.inbox.join("done.json")).unwrap();
    let record = settled(&mut grinder).answer.unwrap();
    assert_eq!((record.map_identity, record.outcome, record.wheel_radius_mm), (map_identity, Outcome::Complete, None));
    assert!(record.duration_s > Some(0.0) && record.cycle == 2);
    assert!(matches!(
        grinder.publish(job, 5, &GrindOrder { map: map(), pass: pass(), map_identity }, &Permit::new()),
        Err(ExchangeError::HandedOver { .. })
    ));
    match grinder.confirm(job, ConfirmedStep::Done, [1; 32]) {
        Err(ExchangeError::OtherMap { expected, found }) => assert_eq!((expected, found), (map_identity, [1; 32])),
        other => panic!("{other:?}"),
    }
}

// ---- the drivers -----------------------------------------------------------------------------------------------------------------

/// Time limit for folders of a test, which are on this computer.
const ANSWERS_WITHIN: Duration = Duration::from_secs(10);

fn at_once(settings: CmmExchange) -> CmmExchange {
    CmmExchange { stable_for: Duration::ZERO, ..settings }
}

async fn connected(shop: &Shop) -> ExchangeMachine<CmmFolders> {
    let folders = CmmFolders::new(at_once(shop.cmm()));
    let mut cmm = ExchangeMachine::new("cmm", MachineKind::Cmm, folders, ANSWERS_WITHIN);
    assert_eq!(cmm.connect().await.unwrap().kind, MachineKind::Cmm);
    cmm.claim().await.unwrap();
    cmm
}

fn answer_of<T: std::fmt::Debug>(told: Result<T, DeviceError>) -> Answer {
    match told.unwrap_err() {
        DeviceError::Refused { answer, .. } => answer,
        other => panic!("{other}"),
    }
}

#[tokio::test]
async fn exchange_cmm_state_sequence() {
    let shop = Shop::new();
    let mut cmm = connected(&shop).await;
    let plan = plan(3);
    let job = Job { job: 3, cycle: 2, digest: digest(&[plan.identity()]) };
    assert_eq!(answer_of(cmm.prepare(job).await), Answer::PayloadMissing);
    cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
    assert_eq!(answer_of(cmm.prepare(Job { digest: 1, ..job }).await), Answer::OtherJob);
    let armed = cmm.prepare(job).await.unwrap();
    assert_eq!(cmm.status().await.unwrap().state, MachineState::Prepared);
    assert!(shop.handed().is_empty());
    assert!(matches!(cmm.reconcile(&armed).await.unwrap(), Reconciled::NotStarted(_)));
    // A job that was reported as not started does not start any more.
    assert_eq!(answer_of(cmm.start(armed).await), Answer::WrongState);
    assert!(shop.handed().is_empty());
    let armed = cmm.prepare(job).await.unwrap();
    let started = cmm.start(armed.clone()).await.unwrap();
    assert_eq!((started.status.state, shop.handed().len()), (MachineState::Execute, 1));
    assert_eq!(answer_of(cmm.start(armed.clone()).await), Answer::WrongState);
    assert!(matches!(Cmm::collect(&mut cmm, job, &Interrupt::new()).await, Err(DeviceError::NoResult { .. })));
    // While held, the plan is not in the outbox; after a resume it is.
    assert_eq!(cmm.hold().await.unwrap().state, MachineState::Held);
    assert_eq!(shop.handed(), ["SN_7_j3_c2.held"]);
    assert_eq!(cmm.resume().await.unwrap().state, MachineState::Execute);
    assert!(cmm.status().await.unwrap().state == MachineState::Execute && cmm.notes()[0].contains("waiting for"));
    shop.put("SN_7_c2.csv", &three());
    let status = cmm.status().await.unwrap();
    assert_eq!(
        (status.state, status.outcome, status.done),
        (MachineState::Complete, Outcome::Complete, armed.start_sequence)
    );
    let found = Cmm::collect(&mut cmm, job, &Interrupt::new()).await.unwrap();
    assert_eq!((found.points.len(), found.done), (3, status.done));
    assert_eq!(answer_of(cmm.acknowledge(status.done + 1).await), Answer::OtherResult);
    assert_eq!(cmm.acknowledge(status.done).await.unwrap().state, MachineState::Idle);
    assert_eq!(shop.handed(), ["SN_7_j3_c2.done"]);
    assert_eq!(answer_of(cmm.prepare(job).await), Answer::AlreadyBegun);
}

#[tokio::test]
async fn hold_and_resume_while_reading_file() {
    let shop = Shop::new();
    let folders = CmmFolders::new(CmmExchange { read_timeout: Duration::ZERO, ..at_once(shop.cmm()) });
    let mut cmm = ExchangeMachine::new("cmm", MachineKind::Cmm, folders, ANSWERS_WITHIN);
    cmm.connect().await.unwrap();
    cmm.claim().await.unwrap();
    let plan = plan(3);
    let job = Job { job: 3, cycle: 2, digest: digest(&[plan.identity()]) };
    cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
    let armed = cmm.prepare(job).await.unwrap();
    cmm.start(armed).await.unwrap();
    // A map of nine million heights, in a sparse file: reading it takes a while.
    let mut header = vec![0; 834];
    header[..10].copy_from_slice(&[0x88, 0x1b, 0x03, 0x6f, 0, 1, 0, 0, 0x03, 0x42]);
    header[68..76].copy_from_slice(&[0x0b, 0xb8, 0x0b, 0xb8, 0x02, 0x25, 0x51, 0x00]);
    for (at, value) in [(164, 0.5_f32), (168, 6.328e-7), (176, 1.0), (184, 1e-5)] {
        header[at..at + 4].copy_from_slice(&value.to_be_bytes());
    }
    let path = shop.inbox.join("SN_7_c2.dat");
    fs::write(&path, header).unwrap();
    File::options().write(true).open(&path).unwrap().set_len(834 + 4 * 3000 * 3000).unwrap();
    let attributes: String = (0..200_000).map(|k| format!(" a{k}=''")).collect();
    shop.put("other.qif", &format!("<QIFDocument{attributes}/>"));
    assert_eq!(cmm.status().await.unwrap().state, MachineState::Execute);
    assert_eq!(cmm.notes(), ["reading SN_7_c2.dat, other.qif"]);
    assert_eq!(cmm.hold().await.unwrap().state, MachineState::Held);
    assert_eq!(cmm.resume().await.unwrap().state, MachineState::Execute);
    let started = Instant::now();
    while !cmm.notes().iter().any(|note| note.contains("not accepted")) {
        assert!(started.elapsed() < Duration::from_secs(300), "{:?}", cmm.notes());
        tokio::task::yield_now().await;
        assert_eq!(cmm.status().await.unwrap().state, MachineState::Execute);
    }
    assert_eq!(cmm.abort().await.unwrap().state, MachineState::Aborted);
}

#[tokio::test]
async fn restarted_client_reconciles_start() {
    let shop = Shop::new();
    let mut cmm = connected(&shop).await;
    let plan = plan(3);
    let job = Job { job: 3, cycle: 2, digest: digest(&[plan.identity()]) };
    cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
    let armed = cmm.prepare(job).await.unwrap();
    // The future is dropped at once: its work is done completely or not at all, and the folder shows which.
    drop(cmm.start(armed.clone()));
    cmm.start(armed.clone()).await.unwrap();
    drop(cmm);
    let mut cmm = connected(&shop).await;
    assert_eq!(cmm.status().await.unwrap().state, MachineState::Execute);
    assert!(matches!(cmm.reconcile(&armed).await.unwrap(), Reconciled::Running(s) if s.state == MachineState::Execute));
    let other = regrind::device::Armed { start_sequence: 9, ..armed.clone() };
    assert!(matches!(cmm.reconcile(&other).await.unwrap(), Reconciled::Unknown { .. }));
    assert_eq!(cmm.stop().await.unwrap().outcome, Outcome::Stopped);
    assert_eq!(shop.handed(), ["SN_7_j3_c2.stopped"]);
    assert!(matches!(cmm.reconcile(&armed).await.unwrap(), Reconciled::Finished(s) if s.outcome == Outcome::Stopped));
    cmm.acknowledge(armed.start_sequence).await.unwrap();
    // An abort withdraws the next job for good.
    let next = Job { cycle: 3, ..job };
    cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
    let armed = cmm.prepare(next).await.unwrap();
    assert_eq!(armed.start_sequence, 2);
    cmm.start(armed).await.unwrap();
    assert_eq!(cmm.abort().await.unwrap().state, MachineState::Aborted);
    assert_eq!(shop.handed(), ["SN_7_j3_c2.stopped", "SN_7_j3_c3.aborted"]);
    assert_eq!(cmm.clear().await.unwrap().state, MachineState::Idle);
}

#[tokio::test]
async fn exchange_grinder_by_confirmation() {
    let shop = Shop::new();
    let folders = shop.grinder(Duration::ZERO);
    let mut grinder = ExchangeMachine::new("grinder", MachineKind::Grinder, folders, ANSWERS_WITHIN);
    assert!(matches!(grinder.status().await, Err(DeviceError::NotConnected { .. })));
    grinder.connect().await.unwrap();
    let (map, pass) = (map(), pass());
    grinder.load_pass(&map, &pass, &Interrupt::new()).await.unwrap();
    let job = Job { job: 3, cycle: 0, digest: digest(&[map.identity(), pass.identity()]) };
    assert_eq!(answer_of(grinder.prepare(job).await), Answer::NotOwner);
    grinder.claim().await.unwrap();
    let armed = grinder.prepare(job).await.unwrap();
    let started = |map_identity| OperatorConfirmation::Started { map_identity: Some(map_identity) };
    let done = OperatorConfirmation::Done { map_identity: Some(map.identity()), file: None };
    assert_eq!(answer_of(grinder.confirm(done.clone()).await), Answer::WrongState);
    grinder.start(armed).await.unwrap();
    assert!(matches!(grinder.confirm(started([9; 32])).await, Err(DeviceError::Mismatch { .. })));
    grinder.confirm(started(map.identity())).await.unwrap();
    assert_eq!(grinder.status().await.unwrap().state, MachineState::Execute);
    grinder.confirm(done).await.unwrap();
    let status = grinder.status().await.unwrap();
    assert_eq!(status.state, MachineState::Complete);
    let record = Grinder::collect(&mut grinder, job, &Interrupt::new()).await.unwrap();
    assert_eq!(record.map_identity, map.identity());
    grinder.acknowledge(status.done).await.unwrap();
    grinder.load_pass(&map, &pass, &Interrupt::new()).await.unwrap();
    assert_eq!(answer_of(grinder.prepare(job).await), Answer::AlreadyBegun);
}

#[tokio::test]
async fn connect_names_missing_folder() {
    let settings = CmmExchange::new("p", "/nowhere/out", Path::new("/nowhere/in"));
    let mut cmm = ExchangeMachine::new("cmm", MachineKind::Cmm, CmmFolders::new(settings), ANSWERS_WITHIN);
    let error = cmm.connect().await.unwrap_err();
    assert!(error.is_link() && error.to_string().contains("/nowhere/out"), "{error}");
}

/// Folders on a drive that hangs in the middle of the next hand-over, before or after the file has appeared, until it
/// is released.
#[derive(Debug)]
struct Hanging {
    folders: CmmFolders,
    after: bool,
    reached: Option<oneshot::Sender<()>>,
    let_go: mpsc::Receiver<()>,
}

impl Hanging {
    fn hang(&mut self) {
        if let Some(reached) = self.reached.take() {
            reached.send(()).unwrap();
            self.let_go.recv().unwrap();
        }
    }
}

impl Exchange for Hanging {
    type Request = MeasureOrder;
    type Answer = Measurement;

    fn open(&mut self) -> Result<Vec<HandOver>, ExchangeError> {
        self.folders.open()
    }

    fn publish(&mut self, job: Job, number: u32, order: &MeasureOrder, permit: &Permit) -> Result<(), ExchangeError> {
        if !self.after {
            self.hang();
        }
        let published = self.folders.publish(job, number, order, permit);
        self.hang();
        published
    }

    fn mark(&mut self, job: Job, standing: HandOverStatus) -> Result<(), ExchangeError> {
        self.folders.mark(job, standing)
    }

    fn poll(&mut self, now: Duration, job: Job) -> Result<PollResult<Measurement>, ExchangeError> {
        self.folders.poll(now, job)
    }

    fn step(&mut self, job: Job, start_confirmed: bool) -> Result<Option<OperatorStep>, ExchangeError> {
        self.folders.step(job, start_confirmed)
    }
}

/// Runs a START that exceeds its timeout; returns the machine's report after the drive answers again.
async fn late_start(shop: &Shop, after: bool) -> (ExchangeMachine<Hanging>, DeviceError, Reconciled) {
    let (reached, hangs) = oneshot::channel();
    let (go, let_go) = mpsc::channel();
    let folders = CmmFolders::new(at_once(shop.cmm()));
    let folders = Hanging { folders, after, reached: Some(reached), let_go };
    let mut cmm = ExchangeMachine::new("cmm", MachineKind::Cmm, folders, ANSWERS_WITHIN);
    cmm.connect().await.unwrap();
    cmm.claim().await.unwrap();
    let plan = plan(3);
    cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
    let job = Job { job: 3, cycle: 2, digest: digest(&[plan.identity()]) };
    let armed = cmm.prepare(job).await.unwrap();
    let time_passes = async {
        hangs.await.unwrap();
        tokio::time::advance(ANSWERS_WITHIN + Duration::from_secs(1)).await;
    };
    let (told, ()) = tokio::join!(cmm.start(armed.clone()), time_passes);
    go.send(()).unwrap();
    let found = cmm.reconcile(&armed).await.unwrap();
    (cmm, told.unwrap_err(), found)
}

#[tokio::test(start_paused = true)]
async fn timed_out_start_never_handed_over() {
    let shop = Shop::new();
    let (mut cmm, told, found) = late_start(&shop, false).await;
    assert!(matches!(told, DeviceError::TimedOut { .. }), "{told}");
    assert!(matches!(found, Reconciled::NotStarted(_)), "{found:?}");
    assert_eq!(shop.handed(), [] as [&str; 0]);
    // The job can be prepared and started again.
    let job = Job { job: 3, cycle: 2, digest: digest(&[plan(3).identity()]) };
    let armed = cmm.prepare(job).await.unwrap();
    cmm.start(armed).await.unwrap();
    assert_eq!(shop.handed(), ["SN_7_j3_c2"]);
}

#[tokio::test(start_paused = true)]
async fn timed_out_start_withdrawn_if_visible() {
    let shop = Shop::new();
    let (_cmm, told, found) = late_start(&shop, true).await;
    assert!(matches!(told, DeviceError::StartUnknown { .. }), "{told}");
    assert!(matches!(&found, Reconciled::Finished(status) if status.outcome == Outcome::Stopped), "{found:?}");
    assert_eq!(shop.handed(), ["SN_7_j3_c2.stopped"], "nothing stands open that nobody waits for");
}

// ---- whole cells ----------------------------------------------------------------------------------------------------------------

/// Returns a cell file with these two protocols; the folders are those of two shops.
fn cell_of(wires: [bool; 2], shops: &[Shop; 2]) -> regrind::config::CellConfig {
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("config/modbus-tcp.toml")).unwrap();
    let mut text = text.replace("simulated = true", "simulated = false");
    for (k, table) in ["cmm", "grinder"].into_iter().enumerate().filter(|(k, _)| wires[*k]) {
        let modbus = format!("kind = \"modbus-tcp\"\nhost = \"127.0.0.1\"\nport = 1502{}\nunit = {}\n", k + 1, k + 1);
        assert!(text.contains(&modbus), "{modbus}");
        let (outbox, inbox) = (shops[k].outbox.display(), shops[k].inbox.display());
        text =
            text.replace(&modbus, &format!("kind = \"file-exchange\"\noutbox = \"{outbox}\"\ninbox = \"{inbox}\"\n"));
        text = text.replace(&format!("[{table}.registers]"), "[nothing]");
    }
    let text: String = text.split("[nothing]").enumerate().fold(String::new(), |all, (k, piece)| match k {
        0 => piece.to_owned(),
        // Skip the rest of the removed table, up to the next one.
        _ => all + piece.find("\n[").map_or("", |at| &piece[at..]),
    });
    regrind::config::CellConfig::parse(Path::new("cell.toml"), &text).unwrap_or_else(|problems| panic!("{problems}"))
}

#[tokio::test]
async fn wire_combinations_make_machines() {
    use regrind::setup;
    let recipe = Path::new(env!("CARGO_MANIFEST_DIR")).join("recipes/shallow-wave.toml");
    let recipe = regrind::recipe::Recipe::read(&recipe).unwrap();
    let shops = [Shop::new(), Shop::new()];
    for wires in [[false, false], [false, true], [true, false], [true, true]] {
        let cell = cell_of(wires, &shops);
        let (cmm, grinder) = setup::create_drivers(&recipe, &cell, "SN 7", Path::new("run"), [1, 1]).unwrap();
        let by_files = [cmm.name(), grinder.name()].map(|name| name.contains("by files"));
        assert_eq!(by_files, wires, "{} and {}", cmm.name(), grinder.name());
        // A person can take a week; a network connection cannot. Only files accept a person's confirmation.
        let (_, plan) = setup::prepare(&recipe, &cell).unwrap();
        assert_eq!(plan.deadlines.progress.map(|limit| limit > Duration::from_secs(86_400)), wires);
        let told =
            { grinder }.confirm(OperatorConfirmation::Started { map_identity: Some([0; 32]) }).await.unwrap_err();
        assert_eq!(matches!(told, DeviceError::ConfirmationNotNeeded { .. }), !wires[1], "{told}");
    }
    let cell = cell_of([true, true], &shops);
    fs::remove_dir(&shops[0].outbox).unwrap();
    let told = setup::create_drivers(&recipe, &cell, "SN 7", Path::new("run"), [1, 1]).unwrap_err().to_string();
    assert!(told.contains("cmm.wire.outbox") && told.contains("does not exist"), "{told}");
    assert!(!shops[0].outbox.exists(), "no folder is made");
}
