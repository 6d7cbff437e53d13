//! Interoperability with independent programs: Modbus machines and a client on pymodbus, written from docs/modbus.md
//! alone, in jobs and in a whole run; and our maps in x3pio (tests/device/pymodbus/).
//!
//! They run with the Python that REGRIND_PYTHON names, which must have both packages, or in an environment that is made
//! below the target folder.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use regrind::compensation::ErrorMap;
use regrind::device::{
    Cmm, Coordinates, CorrectionMap, Grinder, Identified, Interrupt, Job, LineAddress, Machine, MachineKind,
    MachineState, ModbusCmm, ModbusGrinder, ModbusSettings, Outcome, Pass, Plan, PlanTarget, Status, TargetKind,
    TouchStatus, digest,
};
use regrind::formats::write_error_map_x3p;
use regrind::geometry::Grid;
use regrind::journal::verify;
use regrind_sim::body::Kind;
use regrind_sim::options::MachineOptions;
use regrind_sim::registers;
use regrind_sim::wire::Serving;
use regrind_testutils::python::with_packages;
use serde_json::Value;

// ---- Python -------------------------------------------------------------------------------------------------------------------------

fn scripts() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/device/pymodbus")
}

/// Returns a Python with the required packages, installed once.
fn python() -> &'static Path {
    static PYTHON: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    let found = PYTHON.get_or_init(|| {
        let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("interop-python");
        with_packages("import pymodbus, x3pio", &scripts().join("requirements.txt"), &home)
    });
    found.as_deref().unwrap_or_else(|why| panic!("no Python with pymodbus and x3pio: {why}"))
}

/// Machine in its own process, which ends when this value is dropped.
struct Process {
    child: Child,
    settings: ModbusSettings,
}

impl Process {
    fn start(python: &Path, script: &str, arguments: &[&str]) -> Self {
        let mut command = Command::new(python);
        let mut child = command.arg(scripts().join(script)).args(arguments).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let port = line.trim().strip_prefix("port ").and_then(|port| port.parse().ok());
        let port = port.unwrap_or_else(|| panic!("{script} said {line:?}"));
        let settings = ModbusSettings {
            request_timeout: Duration::from_secs(5),
            ..ModbusSettings::new(LineAddress::Tcp { host: "127.0.0.1".into(), port })
        };
        Self { child, settings }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

async fn until_complete<M: Machine>(machine: &mut M) -> Status {
    let began = Instant::now();
    loop {
        let status = machine.status().await.unwrap();
        if status.state == MachineState::Complete {
            return status;
        }
        assert!(began.elapsed() < Duration::from_secs(60), "not complete after a minute: {status:?}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

// ---- our drivers, their machines ----------------------------------------------------------------------------------------------------

fn plan() -> Plan {
    let target = |index: u32| PlanTarget {
        index,
        kind: TargetKind::Part,
        point_mm: [f64::from(index), -0.25 * f64::from(index), 3.0],
        normal: [0.6, 0.0, 0.8],
    };
    Plan {
        targets: (0..200).map(target).collect(),
        probe_radius_mm: 2.5,
        approach_mm: 1.0,
        search_mm: 1.0,
        speed_mm_s: 2.0,
        safe_height_mm: 20.0,
        careful_start: None,
    }
}

#[tokio::test]
#[ignore = "needs Python with venv, and pymodbus: see REGRIND_PYTHON"]
async fn driver_measures_on_pymodbus_cmm() {
    let python = python();
    let process = Process::start(python, "cmm.py", &[]);
    let mut cmm = ModbusCmm::new(process.settings.clone()).unwrap();
    let identity = cmm.connect().await.unwrap();
    assert_eq!((identity.kind, identity.name.as_str()), (MachineKind::Cmm, "pymodbus CMM 1"));
    cmm.claim().await.unwrap();
    let (plan, calm) = (plan(), Interrupt::new());
    for cycle in 1..=2 {
        cmm.load_plan(&plan, &calm).await.unwrap();
        let job = Job { job: 5, cycle, digest: digest(&[plan.identity()]) };
        let armed = cmm.prepare(job).await.unwrap();
        cmm.start(armed.clone()).await.unwrap();
        let status = until_complete(&mut cmm).await;
        assert_eq!((status.done, status.outcome), (armed.start_sequence, Outcome::Complete));
        let measured = cmm.collect(job, &calm).await.unwrap();
        assert_eq!((measured.coordinates, measured.probe_radius_mm), (Coordinates::Centres, Some(2.5)));
        for (target, point) in plan.targets.iter().zip(&measured.points) {
            // The machine's own known error: 0.1 um along x at every odd index.
            let x_mm = target.point_mm[0] + 1e-4 * f64::from(target.index % 2) + 2.5 * target.normal[0];
            assert_eq!((point.index, point.status, point.position_mm[0]), (target.index, TouchStatus::Touched, x_mm));
        }
        assert_eq!(measured.points.len(), 200);
        cmm.acknowledge(measured.done).await.unwrap();
    }
    let figures = cmm.link().statistics();
    println!("{} answers, {:.0} us each", figures.answers, figures.answer_ns as f64 / 1e3 / figures.answers as f64);
}

#[tokio::test]
#[ignore = "needs Python with venv, and pymodbus: see REGRIND_PYTHON"]
async fn pymodbus_cmm_read_ahead() {
    let process = Process::start(python(), "cmm.py", &["--ahead", "--seconds", "3"]);
    let mut cmm = ModbusCmm::new(process.settings.clone()).unwrap();
    cmm.connect().await.unwrap();
    cmm.claim().await.unwrap();
    let (plan, calm) = (plan(), Interrupt::new());
    cmm.load_plan(&plan, &calm).await.unwrap();
    let job = Job { job: 5, cycle: 1, digest: digest(&[plan.identity()]) };
    let armed = cmm.prepare(job).await.unwrap();
    cmm.start(armed).await.unwrap();
    let mut came = Vec::new();
    while cmm.status().await.unwrap().state != MachineState::Complete {
        came.extend(cmm.read_ahead(job, &calm).await.into_iter().flat_map(|told| told.points));
    }
    let measured = cmm.collect(job, &calm).await.unwrap();
    println!("{} of {} points came while it measured", came.len(), measured.points.len());
    assert!(!came.is_empty() && came == measured.points[..came.len()]);
    assert_eq!(measured.points.len(), 200);
}

#[tokio::test]
#[ignore = "needs Python with venv, and pymodbus: see REGRIND_PYTHON"]
async fn driver_grinds_on_pymodbus_grinder() {
    let python = python();
    // Long enough for a hold to arrive before its end on any computer.
    let process = Process::start(python, "grinder.py", &["--seconds", "3"]);
    let mut grinder = ModbusGrinder::new(process.settings.clone()).unwrap();
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    let map = CorrectionMap {
        grid: Grid { columns: 30, rows: 20, first_mm: [0.0, 0.0], spacing_mm: [1.0, 1.5] },
        values_mm: (0..600).map(|k| 1e-5 * f64::from(k)).collect(),
        part_identity: [3; 32],
    };
    let pass = Pass { x_mm: [0.0, 29.0], y_mm: [0.0, 28.5], part_identity: [3; 32], ..crate::toy::pass() };
    let calm = Interrupt::new();
    grinder.load_pass(&map, &pass, &calm).await.unwrap();
    let job = Job { job: 6, cycle: 1, digest: digest(&[map.identity(), pass.identity()]) };
    let armed = grinder.prepare(job).await.unwrap();
    grinder.start(armed).await.unwrap();
    grinder.hold().await.unwrap();
    assert_eq!(grinder.status().await.unwrap().state, MachineState::Held);
    grinder.resume().await.unwrap();
    until_complete(&mut grinder).await;
    let record = grinder.collect(job, &calm).await.unwrap();
    assert_eq!((record.outcome, record.wheel_radius_mm, record.idle_share), (Outcome::Complete, Some(25.0), Some(1.0)));
    assert_eq!(record.map_identity, map.identity());
    grinder.acknowledge(record.done).await.unwrap();
    grinder.release().await.unwrap();
    assert_eq!(grinder.status().await.unwrap().state, MachineState::Idle);
}

/// Runs the whole program against both: grind, measure, register, judge, compensate, until the part is accepted.
#[test]
#[ignore = "needs Python with venv, and pymodbus: see REGRIND_PYTHON"]
fn whole_run_on_pymodbus_machines() {
    let python = python();
    let home = tempfile::tempdir().unwrap();
    let part = home.path().join("part.bin");
    let part = part.to_str().unwrap();
    let cmm = Process::start(python, "cmm.py", &["--part", part]);
    let grinder = Process::start(python, "grinder.py", &["--part", part, "--unit", "2"]);
    let port = |process: &Process| match &process.settings.line {
        LineAddress::Tcp { port, .. } => format!("port = {port}"),
        LineAddress::Rtu { .. } => unreachable!("both serve TCP"),
    };
    let recipe = crate::program::small_recipe(home.path(), 1.0);
    let named = "# expected_name = \"CMM 7, serial 12345\"";
    let changes = [
        ("port = 15021", &*port(&cmm)),
        ("port = 15022", &*port(&grinder)),
        (named, "expected_name = \"pymodbus CMM 1\""),
        ("request_timeout_ms = 500", "request_timeout_ms = 2000"),
        ("lost_after_ms = 3000", "lost_after_ms = 30000"),
    ];
    let write = |name: &str, text: String| std::fs::write(home.path().join(name), text).unwrap();
    write("cell.toml", crate::program::changed("config/modbus-tcp.toml", &changes));
    let recipe = recipe.to_str().unwrap();
    let arguments = ["run", recipe, "--cell", "cell.toml", "--runs", "runs", "--part", "SN-3"];
    let (code, said, errors) = crate::program::run(&arguments, home.path());
    assert_eq!(code, 0, "{said}\n{errors}");
    assert!(said.contains("SIMULATION  ACCEPTED") && errors.is_empty(), "{said}\n{errors}");
    let folder = crate::program::only_run(&home.path().join("runs"));
    let verified = verify(&folder).unwrap();
    assert!(verified.closed && verified.open_intents.is_empty(), "{verified:?}");
    let result: Value = serde_json::from_slice(&std::fs::read(folder.join("result.json")).unwrap()).unwrap();
    let cycles = result["cycles"].as_array().unwrap();
    let rms_um = |cycle: &Value| cycle["rms_um"].as_f64().unwrap();
    println!("pymodbus machines: rms {:.2} um, then {:.3} um", rms_um(&cycles[0]), rms_um(&cycles[1]));
    assert_eq!(cycles.len(), 2, "{result}");
    assert!(rms_um(&cycles[0]) > 3.0 && rms_um(&cycles[1]) < 0.3 * rms_um(&cycles[0]), "{result}");

    // The same cell file with another name in it: the machine is not the configured one, and nothing begins.
    write(
        "other.toml",
        crate::program::changed(
            "config/modbus-tcp.toml",
            &[&changes[..2], &[(named, "expected_name = \"CMM 8\"")]].concat(),
        ),
    );
    let (code, said, errors) =
        crate::program::run(&["run", recipe, "--cell", "other.toml", "--runs", "other"], home.path());
    assert_eq!(code, 3, "{said}\n{errors}");
    let all = format!("{said}{errors}");
    assert!(all.contains("name \"pymodbus CMM 1\"") && all.contains("expects \"CMM 8\""), "{all}");
    // A cell file that declares these machines as real.
    write(
        "real.toml",
        crate::program::changed(
            "config/modbus-tcp.toml",
            &[&changes[..2], &[("simulated = true", "simulated = false")]].concat(),
        ),
    );
    let (code, said, errors) =
        crate::program::run(&["run", recipe, "--cell", "real.toml", "--runs", "real", "--loaded"], home.path());
    assert_eq!(code, 3, "{said}\n{errors}");
    let all = format!("{said}{errors}");
    assert!(all.contains("is a simulation") && all.contains("simulated = false"), "{all}");
}

// ---- their client, our machine ------------------------------------------------------------------------------------------------------

#[tokio::test]
#[ignore = "needs Python with venv, and pymodbus: see REGRIND_PYTHON"]
async fn pymodbus_client_measures_on_sim_cmm() {
    let python = python();
    let machine = registers::SimulatedMachine::new(
        Box::new(crate::toy::Toy::new(Kind::Cmm, 100.0)),
        77,
        MachineOptions::default(),
    );
    let serving = Serving::tcp("127.0.0.1:0", vec![(1, machine)]).await.unwrap();
    let port = serving.local_addr().unwrap().port().to_string();
    let mut client = Command::new(python);
    client.arg(scripts().join("client.py")).args(["127.0.0.1", &port]);
    let done = tokio::task::spawn_blocking(move || client.output()).await.unwrap().unwrap();
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{said}{}", String::from_utf8_lossy(&done.stderr));
    let points: Vec<&str> = said.lines().collect();
    assert_eq!(points.len(), 10, "{said}");
    assert_eq!(points[3], "3 1 0 3.0 1.5 1.5");
    assert_eq!(serving.machine(1).unwrap().with(|machine| machine.began().len()), 1);
}

// ---- our maps, their reader ---------------------------------------------------------------------------------------------------------

#[test]
#[ignore = "needs Python with venv, and pymodbus: see REGRIND_PYTHON"]
fn x3p_opens_in_other_reader() {
    let python = python();
    let grid = Grid { columns: 31, rows: 17, first_mm: [-51.0, -31.0], spacing_mm: [3.4, 3.875] };
    let values_mm: Vec<f64> = (0..grid.len()).map(|k| 1e-3 * (0.37 * k as f64).sin() + 1e-9 * k as f64).collect();
    let valid: Vec<bool> = (0..grid.len()).map(|k| k % 7 != 3).collect();
    let map = ErrorMap::exact(grid, values_mm, valid);
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("error_map.x3p");
    write_error_map_x3p(&path, &map, "2026-03-01T12:00:00Z", true).unwrap();
    let done = Command::new(python).arg(scripts().join("x3p.py")).arg(&path).output().unwrap();
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{said}{}", String::from_utf8_lossy(&done.stderr));
    let read: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!((&read["columns"], &read["rows"]), (&31.into(), &17.into()));
    let list = |name: &str| -> Vec<Option<f64>> { serde_json::from_value(read[name].clone()).unwrap() };
    let (x, y, z) = (list("x_m"), list("y_m"), list("z_m"));
    assert_eq!([x.len(), y.len(), z.len()], [grid.len(); 3]);
    for k in 0..grid.len() {
        let [px, py] = grid.place_mm(k);
        let is = |found: Option<f64>, mm: f64| found.is_some_and(|m| (1e3 * m - mm).abs() <= 1e-12 * mm.abs().max(1.0));
        assert!(is(x[k], px) && is(y[k], py), "{k}: {:?} {:?}", x[k], y[k]);
        assert_eq!(
            z[k].map(|m| 1e3 * m - map.nodes.values_mm[k]).map(|d| d.abs() < 1e-18),
            map.nodes.valid[k].then_some(true),
            "{k}"
        );
    }
    // The mask agrees with the values.
    let mask: Vec<bool> = serde_json::from_value(read["mask"].clone()).unwrap();
    assert_eq!(mask, map.nodes.valid);
    assert!(read["comment"].as_str().unwrap().starts_with("SIMULATION"), "{read}");
    assert_eq!(read["date"], "2026-03-01T12:00:00+00:00");
}
