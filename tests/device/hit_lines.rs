//! Driver of a machine that prints its hits, at the near end of a real serial line (a pseudo-terminal) or of a TCP
//! connection.
//!
//! Nothing here depends on time: the tests wait for a point, a refusal or a state, however long that takes.
#![cfg(unix)]

use std::path::Path;
use std::time::Duration;

use regrind::device::hit_lines::{HitLinesCmm, HitLinesSettings, HitSource, LineFormat, LineParser, Repeated};
use regrind::device::{
    Cmm as _, Coordinates, Identified, Interrupt, Job, Machine, MachineState, Measurement, OperatorConfirmation,
    Outcome, Parity, Plan, PlanTarget, TargetKind, TouchStatus, digest,
};
use regrind_sim::hits::faults::Fault;
use regrind_sim::hits::print::Style;
use regrind_sim::wire::hits::ServingHits;

/// Timeout longer than any test.
const LONG: Duration = Duration::from_secs(600);

/// Returns a plan of targets in a row, 50 mm apart, on a plane that faces up.
fn plan(targets: u32) -> Plan {
    let point_mm = |k: u32| [100.0 + 50.0 * f64::from(k), 200.0, 298.5];
    let what = TargetKind::Part;
    let target = |k| PlanTarget { index: 7 + k, kind: what, point_mm: point_mm(k), normal: [0.0, 0.0, 1.0] };
    Plan {
        targets: (0..targets).map(target).collect(),
        probe_radius_mm: 1.5,
        approach_mm: 2.0,
        search_mm: 2.0,
        speed_mm_s: 5.0,
        safe_height_mm: 50.0,
        careful_start: None,
    }
}

fn settings(folder: &Path, line: HitSource) -> HitLinesSettings {
    HitLinesSettings {
        part: "SN-7".into(),
        run_folder: folder.to_owned(),
        plan_folder: None,
        source: line,
        parser: LineParser::default(),
        coordinates: Coordinates::Centres,
        rotary_deg: [245.5, 0.05],
        limit_mm: 1.0,
        duplicate_window: LONG,
        repeated: Repeated::Refuse,
        line_timeout: LONG,
        ignored_prefixes: vec!["PROBE".into()],
        clear_after: None,
        min_free_points: None,
        connect_timeout: LONG,
        silence: Duration::from_millis(1),
        simulated: true,
    }
}

fn serial(port: &Path) -> HitSource {
    let device = port.display().to_string();
    HitSource::Serial { device, baud: 9600, data_bits: 8, parity: Parity::None, stop_bits: 1 }
}

struct Bench {
    cmm: HitLinesCmm,
    serving: ServingHits,
    job: Job,
    folder: tempfile::TempDir,
}

impl Bench {
    /// Starts a measurement.
    async fn new(
        targets: u32,
        serving: ServingHits,
        line: HitSource,
        change: impl FnOnce(&mut HitLinesSettings),
    ) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut settings = settings(folder.path(), line);
        change(&mut settings);
        let (mut cmm, plan) = (HitLinesCmm::new(settings), plan(targets));
        let job = Job { job: 3, cycle: 1, digest: digest(&[plan.identity()]) };
        assert!(cmm.connect().await.unwrap().simulation);
        cmm.claim().await.unwrap();
        cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
        let armed = cmm.prepare(job).await.unwrap();
        let started = cmm.start(armed).await.unwrap();
        assert_eq!((started.status.state, started.status.clear_of_part), (MachineState::Execute, None));
        Self { cmm, serving, job, folder }
    }

    async fn on_serial(targets: u32, change: impl FnOnce(&mut HitLinesSettings)) -> Self {
        let serving = ServingHits::serial().unwrap();
        let line = serial(serving.path().unwrap());
        Self::new(targets, serving, line, change).await
    }

    /// Waits until this number of targets is touched, and returns the state.
    async fn until(&mut self, touched: u32, state: MachineState) {
        loop {
            let status = self.cmm.status().await.unwrap();
            if status.state == state && status.progress.unwrap().0 == touched {
                return;
            }
            assert!(status.progress.unwrap().0 <= touched, "{status:?}\n{}", self.notes());
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }

    fn notes(&self) -> String {
        self.cmm.notes().join("\n")
    }

    async fn done(&mut self) -> Measurement {
        let kept = self.cmm.confirm(OperatorConfirmation::Done { map_identity: None, file: None }).await.unwrap();
        assert_eq!(kept, ["cycle-1/plan.csv", "cycle-1/hits.jsonl"]);
        assert!(kept.iter().all(|file| self.folder.path().join(file).is_file()));
        let status = self.cmm.status().await.unwrap();
        assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete));
        assert_eq!(status.clear_of_part, Some(true));
        self.cmm.collect(self.job, &Interrupt::new()).await.unwrap()
    }
}

/// Lines of the page that defines the formats, byte for byte.
const GOLDEN: [(LineFormat, &[u8]); 8] = [
    (LineFormat::Decimal, b"100.000,200.000,300.000\r\n"),
    (LineFormat::Integer, b"100000,200000,300000\r\n"),
    (LineFormat::LetteredDecimal, b"X100.000,Y200.000,Z300.000\r\n"),
    (LineFormat::LetteredInteger, b"X100000,Y200000,Z300000\r\n"),
    (LineFormat::DecimalRotary, b"100.000,200.000,300.000,245.5\r\n"),
    (LineFormat::IntegerRotary, b"100000,200000,300000,2455\r\n"),
    (LineFormat::LetteredDecimalRotary, b"X100.000,Y200.000,Z300.000,W245.5\r\n"),
    (LineFormat::LetteredIntegerRotary, b"X100000,Y200000,Z300000,W2455\r\n"),
];

#[tokio::test]
async fn hit_formats_over_serial_line() {
    for (format, line) in GOLDEN {
        let style = Style {
            letters: format.is_lettered(),
            whole: format.is_integer(),
            rotary_deg: format.has_rotary().then_some(245.5),
            ..Style::default()
        };
        assert_eq!(style.line([100.0, 200.0, 300.0]), line, "the simulated machine prints it alike");
        let mut bench = Bench::on_serial(1, |settings| settings.parser.format = format).await;
        // The line arrives in two pieces.
        let (begin, rest) = line.split_at(line.len() / 2);
        bench.serving.send(begin).await;
        bench.serving.send(rest).await;
        bench.until(1, MachineState::Execute).await;
        let measured = bench.done().await;
        assert_eq!(measured.points[0].position_mm, [100.0, 200.0, 300.0], "{format:?}");
        assert_eq!((measured.points[0].index, measured.points[0].status), (7, TouchStatus::Touched));
        assert_eq!((measured.coordinates, measured.probe_radius_mm), (Coordinates::Centres, None));
        bench.cmm.acknowledge(measured.done).await.unwrap();
        assert_eq!(bench.cmm.status().await.unwrap().state, MachineState::Idle);
    }
}

/// Returns the lines of a printer whose second line has a fault, up to this number of targets.
fn with_fault(fault: &Fault) -> Vec<u8> {
    let line = |k: usize| Style::default().line([100.0 + 50.0 * k as f64, 200.0, 300.0]);
    (0..4).flat_map(|k| if k == 1 { fault.spoil(line(k)) } else { line(k) }).collect()
}

#[tokio::test]
async fn damaged_hit_line_is_touched_again() {
    // Fault, number of the four targets that are touched anyway, and pieces of the message.
    for (fault, touched, why) in [
        (Fault::Lost(4), 3, ["line 2 ", "150.00,200.000,300.000", "3 digits"]),
        (Fault::Lost(0), 3, ["line 2 ", "50.000 mm", "nearest target, 7"]),
        (Fault::Garbled(1), 3, ["REFUSED line 2 ", "1u0.000,200.000,300.000", "value 1 of"]),
        (Fault::Merged, 2, ["REFUSED line", "instead of 3", "two lines are joined"]),
        (Fault::Stranger("SN 00412".into()), 4, ["SN 00412", "1 values", "instead of 3"]),
    ] {
        let mut bench = Bench::on_serial(4, |_| {}).await;
        let lines = with_fault(&fault);
        bench.serving.send(&lines).await;
        bench.until(touched, MachineState::Holding).await;
        let notes = bench.notes();
        for piece in why.into_iter().chain(["confirm still", "--machine cmm"]) {
            assert!(notes.contains(piece), "{fault:?}, {piece}: {notes}");
        }
        bench.cmm.confirm(OperatorConfirmation::Still).await.unwrap();
        bench.until(touched, MachineState::Held).await;
        bench.cmm.resume().await.unwrap();
        // The person looks at the remaining targets, and touches them.
        for k in [1, 2] {
            if bench.cmm.status().await.unwrap().progress.unwrap().0 < 4 && (k == 1 || touched == 2) {
                bench.serving.send(&Style::default().line([100.0 + 50.0 * f64::from(k), 200.0, 300.0])).await;
                bench.until(if touched == 2 { 2 + k } else { 4 }, MachineState::Execute).await;
            }
        }
        let measured = bench.done().await;
        for (k, point) in measured.points.iter().enumerate() {
            assert_eq!(point.position_mm, [100.0 + 50.0 * k as f64, 200.0, 300.0], "{fault:?}");
        }
    }
}

#[tokio::test]
async fn duplicate_hit_line_used_once() {
    let mut bench = Bench::on_serial(4, |_| {}).await;
    bench.serving.send(b"PROBE 1\r\n").await;
    bench.serving.send(&with_fault(&Fault::Twice)).await;
    bench.until(4, MachineState::Execute).await;
    assert!(bench.notes().contains("1 lines arrived twice"), "{}", bench.notes());
    bench.done().await;
}

#[tokio::test]
async fn lost_hit_line_leaves_target_open() {
    let mut bench = Bench::on_serial(4, |_| {}).await;
    bench.serving.send(&with_fault(&Fault::Dropped)).await;
    bench.until(3, MachineState::Execute).await;
    let named = OperatorConfirmation::Done { map_identity: None, file: Some("x.csv".into()) };
    assert!(bench.cmm.confirm(named).await.unwrap_err().to_string().contains("remove --file"));
    let measured = bench.done().await;
    let status: Vec<TouchStatus> = measured.points.iter().map(|point| point.status).collect();
    assert_eq!((status[0], status[1]), (TouchStatus::Touched, TouchStatus::NotFound));
}

#[tokio::test]
async fn repeated_touch_replaces_if_configured() {
    for (repeated, first) in [(Repeated::Refuse, true), (Repeated::Replace, false)] {
        let mut bench = Bench::on_serial(2, |settings| settings.repeated = repeated).await;
        bench.serving.send(b"100.000,200.000,300.000\r\n100.010,200.000,300.000\r\n150.000,200.000,300.000\r\n").await;
        bench.until(2, if first { MachineState::Holding } else { MachineState::Execute }).await;
        let measured = bench.done().await;
        assert_eq!(measured.points[0].position_mm[0], if first { 100.0 } else { 100.01 });
    }
}

#[tokio::test]
async fn hit_lines_tcp_loss_preserves_points() {
    let serving = ServingHits::tcp("127.0.0.1:0").await.unwrap();
    let port = serving.local_addr().unwrap().port();
    let mut bench = Bench::new(3, serving, HitSource::Tcp { host: "127.0.0.1".into(), port }, |_| {}).await;
    bench.serving.send(b"100.000,200.000,300.000\r\n150.000,200.0").await;
    bench.until(1, MachineState::Execute).await;
    bench.serving.hang_up().await;
    let lost = loop {
        if let Err(lost) = bench.cmm.status().await {
            break lost;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    };
    assert!(lost.is_link(), "{lost}");
    bench.cmm.connect().await.unwrap();
    // A touch in the meantime was lost, and the state of the machine is unknown.
    bench.until(1, MachineState::Holding).await;
    let notes = bench.notes();
    assert!(
        notes.contains("incomplete") && notes.contains("the connection was lost") && notes.contains("2 targets remain"),
        "{notes}"
    );
    bench.cmm.confirm(OperatorConfirmation::Still).await.unwrap();
    bench.cmm.resume().await.unwrap();
    bench.serving.send(b"150.000,200.000,300.000\r\n200.000,200.000,300.000\r\n").await;
    bench.until(3, MachineState::Execute).await;
    assert_eq!(bench.done().await.points.len(), 3);
}

#[tokio::test]
async fn unplugged_port_and_stale_input() {
    let serving = ServingHits::serial().unwrap();
    // Possibly of another part.
    serving.send(b"100.000,200.000,300.000\r\n").await;
    // A link with a name that no other test uses: the operating system gives the number of a closed pseudo-terminal
    // to the next one that is opened, also to that of another test.
    let ports = tempfile::tempdir().unwrap();
    let port = ports.path().join("port");
    std::os::unix::fs::symlink(serving.path().unwrap(), &port).unwrap();
    let line = serial(&port);
    let mut bench = Bench::new(2, serving, line, |_| {}).await;
    bench.serving.send(b"150.000,200.000,300.000\r\n").await;
    bench.until(1, MachineState::Execute).await;
    assert_eq!(bench.cmm.read_ahead(bench.job, &Interrupt::new()).await, None, "the first target is not touched");
    std::fs::remove_file(&port).unwrap();
    bench.serving = ServingHits::serial().unwrap();
    while bench.cmm.status().await.is_ok() {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert!(bench.cmm.connect().await.is_err());
}

#[tokio::test]
async fn hold_stop_abort_need_operator() {
    let mut bench = Bench::on_serial(2, |_| {}).await;
    assert_eq!(bench.cmm.hold().await.unwrap().state, MachineState::Holding);
    bench.serving.send(b"100.000,200.000,300.000\r\n").await;
    bench.until(1, MachineState::Holding).await;
    for piece in ["HOLD", "1 targets remain: 8"] {
        assert!(bench.notes().contains(piece), "{piece}: {}", bench.notes());
    }
    bench.cmm.confirm(OperatorConfirmation::Still).await.unwrap();
    assert_eq!(bench.cmm.stop().await.unwrap().outcome, Outcome::Stopped);
    let mut bench = Bench::on_serial(2, |_| {}).await;
    assert_eq!(bench.cmm.abort().await.unwrap().state, MachineState::Aborting);
    assert!(bench.notes().contains("NOW"));
}
