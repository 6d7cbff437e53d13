//! Test against a server that was written in another language, from the facts of the standard alone (server.py): a cap
//! of a sphere.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use regrind::device::{
    Cmm, Interrupt, IppdmeCmm, Machine, MachineState, Outcome, Plan, PlanTarget, TargetKind, TouchStatus,
};

use super::bench::{begin, job, patient, settings, until_still};

struct Python(Child);

impl Drop for Python {
    fn drop(&mut self) {
        // The process has possibly ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn serve() -> (Python, u16) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/device/ippdme/server.py");
    let python = if cfg!(windows) { "python" } else { "python3" };
    let mut child =
        Command::new(python).arg(script).stdout(Stdio::piped()).spawn().expect("a Python, without any package");
    let mut first = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut first).unwrap();
    (Python(child), first.trim().parse().unwrap())
}

#[tokio::test]
#[ignore = "needs a Python"]
async fn other_server_measures_sphere_cap() {
    let (_python, port) = serve();
    let mut cmm = IppdmeCmm::new(settings(port, patient()));
    let identity = cmm.connect().await.unwrap();
    assert_eq!(identity.name, "CartCMM_Simulated, I++ DME before 1.4");
    let target = |index: u32| {
        let (tilt, turn) = (0.02 * f64::from(index), 2.4 * f64::from(index));
        let normal = [tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()];
        // A little off the surface, like a real part.
        let point_mm = [60.01 * normal[0], 60.01 * normal[1], 60.01 * normal[2] - 50.0];
        PlanTarget { index, kind: TargetKind::Part, point_mm, normal }
    };
    let plan = Plan {
        targets: (0..30).map(target).collect(),
        probe_radius_mm: 1.5,
        approach_mm: 2.0,
        search_mm: 2.0,
        speed_mm_s: 3.0,
        safe_height_mm: 10.0,
        careful_start: None,
    };
    begin(&mut cmm, &plan).await.unwrap();
    let status = until_still(&mut cmm).await.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete), "{:?}", cmm.notes());
    let measurement = cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    for point in &measurement.points {
        let [x, y, z] = point.position_mm;
        let distance = (x * x + y * y + (z + 50.0).powi(2)).sqrt();
        assert!(point.status == TouchStatus::Touched && (distance - 61.5).abs() < 1e-6, "{point:?}");
    }
}
