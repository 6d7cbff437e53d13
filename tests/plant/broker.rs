//! Separate broker for each test: mosquitto, on a port that is reserved against other tests.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use crate::program::PATIENCE;

/// Port on which nothing listens, which the system does not assign by itself, and which is reserved against other
/// tests.
pub struct FreePort {
    pub port: u16,
    _kept: fs::File,
}

impl FreePort {
    pub fn find() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        loop {
            let k = std::process::id().wrapping_mul(37).wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed));
            let port = 10_000 + u16::try_from(k % 20_000).unwrap();
            let kept = fs::File::create(std::env::temp_dir().join(format!("regrind-live-port-{port}"))).unwrap();
            if kept.try_lock().is_ok() && TcpListener::bind(("127.0.0.1", port)).is_ok() {
                return Self { port, _kept: kept };
            }
        }
    }
}

pub struct Broker {
    home: TempDir,
    port: FreePort,
    server: Option<Child>,
}

impl Broker {
    /// Starts a broker that accepts everybody.
    pub fn start() -> Self {
        Self::with("allow_anonymous true\n", |_| {})
    }

    /// Starts a broker with additional configuration lines, and files for them in its folder.
    pub fn with(lines: &str, files: impl Fn(&Path)) -> Self {
        loop {
            let mut broker = Self { home: TempDir::new().unwrap(), port: FreePort::find(), server: None };
            let folder = broker.home.path();
            files(folder);
            let lines = lines.replace("FOLDER", &folder.display().to_string());
            // It runs as the user who started it: its files are private.
            let text = format!("user root\npersistence false\nlistener {} 127.0.0.1\n{lines}", broker.port());
            fs::write(folder.join("mosquitto.conf"), text).unwrap();
            // Another process can take the port in the meantime.
            if broker.try_to_go_on() {
                return broker;
            }
        }
    }

    pub fn port(&self) -> u16 {
        self.port.port
    }

    /// Restarts the broker after a kill.
    pub fn go_on(&mut self) {
        assert!(self.try_to_go_on(), "{}", self.log());
    }

    /// Kills the broker, as a loss of power does.
    pub fn kill(&mut self) {
        let Some(mut server) = self.server.take() else { return };
        // The process has possibly ended already.
        let _ = server.kill();
        server.wait().unwrap();
    }

    fn try_to_go_on(&mut self) -> bool {
        assert!(self.server.is_none(), "it runs");
        let log = fs::File::options().create(true).append(true).open(self.home.path().join("log")).unwrap();
        let mut mosquitto = Command::new(program());
        mosquitto.arg("-v").arg("-c").arg(self.home.path().join("mosquitto.conf"));
        let mut server = mosquitto
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .spawn()
            .expect("Debian package mosquitto");
        let began = Instant::now();
        while TcpStream::connect(("127.0.0.1", self.port())).is_err() {
            if server.try_wait().unwrap().is_some() {
                assert!(self.log().contains("Address already in use"), "it does not start:\n{}", self.log());
                return false;
            }
            assert!(began.elapsed() < PATIENCE, "it does not start:\n{}", self.log());
            std::thread::park_timeout(Duration::from_millis(20));
        }
        self.server = Some(server);
        true
    }

    /// Returns the log of the broker.
    pub fn log(&self) -> String {
        fs::read_to_string(self.home.path().join("log")).unwrap_or_default()
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        self.kill();
        if std::thread::panicking() {
            eprintln!("{}", self.log());
        }
    }
}

/// Returns the path of the program; Debian installs it where only root's PATH has it.
fn program() -> PathBuf {
    let there = PathBuf::from("/usr/sbin/mosquitto");
    if there.exists() { there } else { "mosquitto".into() }
}
