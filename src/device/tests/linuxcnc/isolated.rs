//! A controller of its own for each test: the test runs itself again in namespaces of its own, where ports, shared
//! memory, locks and processes are nobody else's and end with it.

use std::fs;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};

/// Set for the test that runs within.
const WITHIN: &str = "REGRIND_WITHIN_LINUXCNC";
/// LinuxCNC does not run as root.
const ACCOUNT: &str = "65534";
pub const PORT: u16 = 5007;

/// Runs a test beside a controller of its own; `name` is its path in this program.
pub fn with_controller<F: Future<Output = ()>>(name: &str, test: impl FnOnce(Controller) -> F) {
    if std::env::var_os(WITHIN).is_some() {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
        return runtime.block_on(async { test(Controller::start().await).await });
    }
    let prepare = "mount -t tmpfs tmpfs /tmp; chmod 1777 /tmp; ip link set lo up; exec \"$@\"";
    let mut command = Command::new("unshare");
    command.args([
        "--ipc",
        "--net",
        "--pid",
        "--mount",
        "--fork",
        "--mount-proc",
        "--kill-child",
        "sh",
        "-euc",
        prepare,
        "sh",
    ]);
    command.arg(std::env::current_exe().unwrap()).args(["--exact", name, "--include-ignored", "--nocapture"]);
    command.env(WITHIN, "1").env_remove("TMPDIR").env_remove("DISPLAY");
    let output = command.output().expect("unshare starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (told, errors) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success() && told.contains("1 passed"), "{told}\n{errors}");
}

/// A three-axis grinder whose joints are where they are told to be.
pub struct Controller {
    pub folder: PathBuf,
    launcher: Child,
}

impl Controller {
    async fn start() -> Self {
        let folder = PathBuf::from("/tmp/controller");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("grinder.ini"), configuration()).unwrap();
        fs::write(folder.join("grinder.hal"), WIRING).unwrap();
        fs::write(folder.join("grinder.tbl"), "T1 P1 D20.0 Z0.0\n").unwrap();
        fs::write(folder.join("grinder.var"), "").unwrap();
        give_away(&folder);
        let launcher = launch(&folder);
        let controller = Self { folder, launcher };
        controller.operator().await.make_ready().await;
        controller
    }

    /// A second client: the person at the machine.
    pub async fn operator(&self) -> Operator {
        Operator::connect(PORT).await
    }

    /// Opens the stop circuit at the machine; no client has a part in it.
    pub fn open_the_stop_circuit(&self) {
        for arguments in [&["unlinkp", "iocontrol.0.emc-enable-in"][..], &["setp", "iocontrol.0.emc-enable-in", "0"]] {
            assert!(as_account("halcmd").args(arguments).status().unwrap().success(), "{arguments:?}");
        }
    }

    /// Has the place of every joint written into a file at every servo cycle: x, y, z in millimetres behind the number
    /// of the sample.
    pub fn sample(&self) -> (Child, PathBuf) {
        let file = self.folder.join("path.txt");
        (as_account("halsampler").arg("-t").arg(&file).spawn().unwrap(), file)
    }

    /// Ends every process of the controller at once, as a power cut does.
    pub fn kill(&mut self) {
        for name in ["linuxcnc", "linuxcncrsh", "milltask", "io", "linuxcncsvr", "rtapi_app"] {
            let _ = Command::new("pkill").args(["-KILL", "-x", name]).status();
        }
        let _ = self.launcher.wait();
    }

    /// Switches it on again.
    pub async fn start_again(&mut self) {
        let _ = fs::remove_file("/tmp/linuxcnc.lock");
        for entry in fs::read_dir("/tmp/controller").unwrap().flatten() {
            if entry.file_name().to_string_lossy().contains("rtapi") {
                let _ = fs::remove_file(entry.path());
            }
        }
        self.launcher = launch(&self.folder);
        self.operator().await.make_ready().await;
    }

    /// A second linuxcncrsh at the same controller, on another port.
    pub fn second_server(&self, port: u16) -> Child {
        let ini = self.folder.join("grinder.ini");
        let port = port.to_string();
        as_account("linuxcncrsh")
            .args(["--port", &port, "--", "-ini"])
            .arg(ini)
            .current_dir(&self.folder)
            .spawn()
            .unwrap()
    }
}

fn as_account(program: &str) -> Command {
    let mut command = Command::new("setpriv");
    command.args(["--reuid", ACCOUNT, "--regid", ACCOUNT, "--clear-groups", program]);
    command.env("HOME", "/tmp/controller").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn launch(folder: &Path) -> Child {
    as_account("linuxcnc").arg(folder.join("grinder.ini")).current_dir(folder).spawn().expect("linuxcnc starts")
}

/// Lets the account of the controller write into a folder.
pub fn give_away(folder: &Path) {
    let owner = format!("{ACCOUNT}:{ACCOUNT}");
    assert!(Command::new("chown").args(["-R", &owner]).arg(folder).status().unwrap().success());
}

/// A client that says what it likes.
pub struct Operator {
    lines: tokio::io::Lines<BufReader<OwnedReadHalf>>,
    to: OwnedWriteHalf,
}

impl Operator {
    pub async fn connect(port: u16) -> Self {
        for _ in 0..600 {
            if let Ok(stream) = TcpStream::connect(("127.0.0.1", port)).await {
                let (from, to) = stream.into_split();
                let mut operator = Self { lines: BufReader::new(from).lines(), to };
                assert!(operator.ask("hello EMC operator 1.0").await.starts_with("HELLO ACK"));
                operator.ask("set echo off").await;
                operator.ask("set verbose on").await;
                return operator;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        panic!(
            "nothing answers on port {port}: {}",
            fs::read_to_string("/tmp/controller/linuxcnc_debug.txt").unwrap_or_default()
        );
    }

    pub async fn ask(&mut self, line: &str) -> String {
        self.to.write_all(format!("{line}\r\n").as_bytes()).await.unwrap();
        loop {
            let told = self.lines.next_line().await.unwrap().expect("it answers").trim().to_owned();
            if !told.is_empty() {
                return told;
            }
        }
    }

    pub async fn take_control(&mut self) {
        assert_eq!(self.ask("set enable EMCTOO").await, "SET ENABLE ACK");
    }

    /// Everything that a person does before work: nothing of it is the driver's.
    pub async fn make_ready(&mut self) {
        self.take_control().await;
        for line in ["set estop off", "set machine on", "set mode manual", "set home -1"] {
            assert!(self.ask(line).await.ends_with("ACK"), "{line}");
        }
        for _ in 0..200 {
            if self.ask("get joint_homed").await.starts_with("JOINT_HOMED YES YES YES") {
                self.ask("set enable off").await;
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        panic!("it is not homed");
    }
}

fn configuration() -> String {
    let limits = |reach: u32| {
        format!("MIN_LIMIT = -{reach}\nMAX_LIMIT = {reach}\nMAX_VELOCITY = 500\nMAX_ACCELERATION = 5000\n")
    };
    let mut text = "[EMC]\nVERSION = 1.1\nMACHINE = bench\n[DISPLAY]\nDISPLAY = linuxcncrsh\n[TASK]\nTASK = milltask\nCYCLE_TIME = 0.001\n\
         [RS274NGC]\nPARAMETER_FILE = grinder.var\n[EMCMOT]\nEMCMOT = motmod\nCOMM_TIMEOUT = 30.0\nSERVO_PERIOD = 1000000\n\
         [EMCIO]\nEMCIO = io\nCYCLE_TIME = 0.010\nTOOL_TABLE = grinder.tbl\n[HAL]\nHALFILE = grinder.hal\n\
         [TRAJ]\nCOORDINATES = X Y Z\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree\nMAX_LINEAR_VELOCITY = 500\nMAX_LINEAR_ACCELERATION = 5000\n\
         [KINS]\nKINEMATICS = trivkins coordinates=XYZ\nJOINTS = 3\n"
        .to_owned();
    for (joint, (axis, reach)) in [("X", 150), ("Y", 150), ("Z", 60)].into_iter().enumerate() {
        let limits = limits(reach);
        text += &format!(
            "[AXIS_{axis}]\n{limits}[JOINT_{joint}]\nTYPE = LINEAR\n{limits}FERROR = 1\nMIN_FERROR = 0.1\nHOME_SEQUENCE = 0\n"
        );
    }
    text
}

/// Every joint is where it is told to be; no stop circuit is outside; and every servo cycle can be sampled.
const WIRING: &str = "loadrt [KINS]KINEMATICS
loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS
loadrt sampler depth=60000 cfg=fff
addf motion-command-handler servo-thread
addf motion-controller servo-thread
addf sampler.0 servo-thread
net x joint.0.motor-pos-cmd => joint.0.motor-pos-fb sampler.0.pin.0
net y joint.1.motor-pos-cmd => joint.1.motor-pos-fb sampler.0.pin.1
net z joint.2.motor-pos-cmd => joint.2.motor-pos-fb sampler.0.pin.2
net stop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in
net tool-prepare iocontrol.0.tool-prepare => iocontrol.0.tool-prepared
net tool-change iocontrol.0.tool-change => iocontrol.0.tool-changed
";
