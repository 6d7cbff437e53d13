//! A run that has left a program, a folder that both see, and a grinder.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use data_encoding::HEXLOWER;
use regrind_core::geometry::Grid;
use regrind_device::{
    Armed, CorrectionMap, DeviceError, Grinder, Identified, Interrupt, Job, LinuxcncGrinder, LinuxcncSettings, Machine,
    MachineState, Pass, Status, digest,
};
use tempfile::TempDir;

/// How a small part is ground.
pub fn pass() -> Pass {
    Pass {
        spark_out_passes: 0,
        wheel_radius_mm: 25.0,
        feed_mm_min: 6000.0,
        track_spacing_mm: 0.2,
        level_mm: 0.1,
        depth_of_cut_mm: 0.02,
        x_mm: [-10.0, 9.0],
        y_mm: [-15.0, 14.0],
        part_identity: [7; 32],
    }
}

/// The map of a pass.
pub fn map() -> CorrectionMap {
    CorrectionMap {
        grid: Grid { columns: 2, rows: 2, first_mm: [0.0, 0.0], spacing_mm: [10.0, 10.0] },
        values_mm: vec![0.0, 0.001, 0.0, 0.0],
        part_identity: [7; 32],
    }
}

/// A program of the map that does this, with the path mode first.
pub fn program(body: &str) -> String {
    format!(
        "(map: sha256 {})\nG21 G90 G94 G17 G40 G49 G80 G54\nG64 P0.0001 Q0\n{body}M2\n",
        HEXLOWER.encode(&map().identity())
    )
}

/// A program that goes to and fro for so many lines.
pub fn to_and_fro(lines: u32) -> String {
    program(&(0..lines).fold("F6000\n".to_owned(), |text, k| text + &format!("G1 X{} Y{}\n", 10 * (k % 2), k % 7)))
}

/// A run with a program, and the folder of programs.
pub struct Bench {
    pub folder: TempDir,
    pub settings: LinuxcncSettings,
}

impl Bench {
    /// The correction of cycle 1, at a server on this port of this computer.
    pub fn new(port: u16, program: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (run, programs) = (folder.path().join("part-20261124T120000Z"), folder.path().join("nc"));
        fs::create_dir_all(run.join("cycle-1")).unwrap();
        fs::create_dir(&programs).unwrap();
        fs::write(run.join("cycle-1/toolpath.ngc"), program).unwrap();
        let settings = LinuxcncSettings {
            host: "127.0.0.1".into(),
            port,
            connect_password: "EMC".into(),
            control_password: "EMCTOO".into(),
            run_folder: run,
            programs_at_controller: programs.display().to_string(),
            programs,
            simulated: false,
            joints: 3,
            answer_timeout: Duration::from_secs(30),
            settle_timeout: Duration::from_secs(30),
            record_timeout: Duration::from_millis(500),
            expected_name: None,
        };
        Self { folder, settings }
    }

    /// A driver, as a program that begins makes it.
    pub fn grinder(&self) -> LinuxcncGrinder {
        LinuxcncGrinder::new(self.settings.clone())
    }

    /// Connects, claims and loads.
    pub async fn loaded(&self) -> LinuxcncGrinder {
        let mut grinder = self.grinder();
        grinder.connect().await.unwrap();
        grinder.claim().await.unwrap();
        grinder.load_pass(&map(), &pass(), &Interrupt::new()).await.unwrap();
        grinder
    }

    /// Goes on until it is prepared.
    pub async fn prepared(&self) -> (LinuxcncGrinder, Armed) {
        let mut grinder = self.loaded().await;
        let armed = grinder.prepare(job()).await.unwrap();
        (grinder, armed)
    }

    /// Goes on until it is started.
    pub async fn started(&self) -> (LinuxcncGrinder, Armed) {
        let (mut grinder, armed) = self.prepared().await;
        let started = grinder.start(armed.clone()).await.unwrap();
        assert_eq!((started.job, started.start_sequence), (job(), armed.start_sequence));
        (grinder, armed)
    }

    /// The only file of programs with this extension.
    pub fn file(&self, extension: &str) -> PathBuf {
        let entries = fs::read_dir(&self.settings.programs).unwrap().map(|entry| entry.unwrap().path());
        let mut found: Vec<_> = entries.filter(|path| path.extension().is_some_and(|e| e == extension)).collect();
        assert_eq!(found.len(), 1, "{found:?}");
        found.remove(0)
    }

    /// How often the program wrote a word.
    pub fn wrote(&self, word: &str) -> usize {
        fs::read_to_string(self.file("log")).unwrap().lines().filter(|line| *line == word).count()
    }
}

/// The pass of cycle 2.
pub fn job() -> Job {
    Job { job: 70_001, cycle: 2, digest: digest(&[map().identity(), pass().identity()]) }
}

/// Asks until it is in a state.
pub async fn until(grinder: &mut LinuxcncGrinder, state: MachineState) -> Status {
    let mut last = None;
    for _ in 0..6000 {
        let status = grinder.status().await.unwrap();
        if status.state == state {
            return status;
        }
        last = Some(status);
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("it does not come to {state}: {last:?} {:?}", grinder.notes());
}

/// Asserts that an answer is an error of the given variant, and returns the error.
#[macro_export]
macro_rules! refuses {
    ($answer:expr, $($pattern:tt)+) => {
        match $answer {
            Err(error) => {
                assert!(matches!(&error, $($pattern)+), "{error:?}: {error}");
                error
            }
            Ok(what) => panic!("not refused: {what:?}"),
        }
    };
}

/// Whether nobody knows what became of a start.
pub fn is_unknown(answer: &Result<regrind_device::Started, DeviceError>) -> bool {
    matches!(answer, Err(DeviceError::StartUnknown { .. }))
}
