//! Separate PostgreSQL for each test, in a folder that is deleted with it. It is reachable only by its socket, and only
//! with a password.

use std::ffi::OsStr;
use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use crate::program::PATIENCE;

/// Owner of the database, who can make roles and is no superuser, as docs/plant.md makes it. Signs in with the password below.
pub const OWNER: &str = "owner";
/// Superuser of the server, who signs in with the same password. Only the tests act as this role.
const SUPERUSER: &str = "postgres";
const PASSWORD: &str = "of-the-owner";
/// Port number in the name of the socket. Nothing listens on this port unless a test asks for TLS.
const PORT: u16 = 5432;

pub struct Postgres {
    home: TempDir,
    bin: PathBuf,
    server: Option<Child>,
    port: u16,
    /// User and group that the server runs as if the test runs as root, because the server refuses root.
    runs_as: Option<(u32, u32)>,
    /// Cluster that other servers can still be copied from.
    copied_from: Option<Arc<TempDir>>,
}

impl Postgres {
    /// Starts a server with an empty database.
    pub fn start() -> Self {
        let home = TempDir::new().unwrap();
        fs::set_permissions(home.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let mut postgres = Self { home, bin: bin(), server: None, port: PORT, runs_as: user(), copied_from: None };
        for folder in ["data", "socket"] {
            let folder = postgres.home.path().join(folder);
            fs::create_dir(&folder).unwrap();
            postgres.give(&folder);
        }
        let password = postgres.home.path().join("owner.password");
        fs::write(&password, PASSWORD).unwrap();
        fs::set_permissions(&password, fs::Permissions::from_mode(0o600)).unwrap();
        postgres.give(&password);
        let made = postgres.made(&password);
        let mut copy = postgres.as_server("cp");
        done(copy.args(["--recursive", "--preserve=mode"]).arg(made.path().join("data/.")).arg(postgres.data()));
        postgres.copied_from = Some(made);
        postgres.go_on();
        postgres.sql("postgres", &format!("CREATE ROLE {OWNER} LOGIN CREATEROLE PASSWORD '{PASSWORD}'"));
        postgres.sql("postgres", &format!("CREATE DATABASE regrind OWNER {OWNER}"));
        postgres
    }

    /// Makes an empty cluster, once for all parallel tests that copy it: making it takes seconds.
    fn made(&self, password: &Path) -> Arc<TempDir> {
        static MADE: Mutex<Weak<TempDir>> = Mutex::new(Weak::new());
        let mut kept = MADE.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(made) = kept.upgrade() {
            return made;
        }
        let made = Arc::new(TempDir::new().unwrap());
        fs::set_permissions(made.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let data = made.path().join("data");
        fs::create_dir(&data).unwrap();
        self.give(&data);
        let mut initdb = self.program("initdb");
        initdb.args(["--no-sync", "--auth=scram-sha-256", "--encoding=UTF8", "--locale=C", "--username", SUPERUSER]);
        done(initdb.arg("--pwfile").arg(password).arg("--pgdata").arg(&data));
        *kept = Arc::downgrade(&made);
        made
    }

    /// Restarts the server after a stop or a kill.
    pub fn go_on(&mut self) {
        self.go_on_with(&[]);
        let began = Instant::now();
        while !self.answers() {
            assert!(self.runs() && began.elapsed() < PATIENCE, "it does not start:\n{}", self.log());
            std::thread::park_timeout(Duration::from_millis(20));
        }
    }

    /// Restarts the server so that it is also reachable by TLS, with a certificate and its key. Returns the port.
    pub fn go_on_by_tls(&mut self, certificate: &Path, key: &Path) -> u16 {
        let kept = ["server.pem", "server.key"].map(|name| self.home.path().join(name));
        for (from, to) in [certificate, key].into_iter().zip(&kept) {
            fs::copy(from, to).unwrap();
            fs::set_permissions(to, fs::Permissions::from_mode(0o600)).unwrap();
            self.give(to);
        }
        let [certificate, key] = kept.map(|path| path.display().to_string());
        for _ in 0..50 {
            self.kill();
            // Another process can take the port before the server does: then try another one.
            let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
            let tls = format!("ssl_cert_file={certificate}");
            let key = format!("ssl_key_file={key}");
            self.go_on_with(&["-h", "127.0.0.1", "-c", "ssl=on", "-c", &tls, "-c", &key, "-p", &port.to_string()]);
            self.port = port;
            while self.runs() && !self.answers() {
                std::thread::park_timeout(Duration::from_millis(20));
            }
            if self.runs() {
                return port;
            }
            self.server = None;
        }
        panic!("no port is free:\n{}", self.log());
    }

    fn runs(&mut self) -> bool {
        self.server.as_mut().is_some_and(|server| server.try_wait().unwrap().is_none())
    }

    fn go_on_with(&mut self, more: &[&str]) {
        assert!(self.server.is_none(), "it runs");
        let mut postgres = self.program("postgres");
        postgres.arg("-D").arg(self.data()).arg("-k").arg(self.socket()).args(["-p", &self.port.to_string(), "-h", ""]);
        postgres.args(["-c", "fsync=off", "-c", "max_connections=60", "-c", "shared_buffers=32MB"]).args(more);
        let log = fs::File::options().create(true).append(true).open(self.home.path().join("log")).unwrap();
        let server = postgres.stdin(Stdio::null()).stdout(log.try_clone().unwrap()).stderr(log).spawn().unwrap();
        self.server = Some(server);
    }

    /// Kills the server with all its processes, as a loss of power does.
    pub fn kill(&mut self) {
        let Some(mut server) = self.server.take() else { return };
        // The server ends its own child processes: an immediate shutdown writes nothing more.
        let ended = Command::new("sh").args(["-c", &format!("kill -QUIT {}", server.id())]).status().unwrap();
        assert!(ended.success());
        server.wait().unwrap();
    }

    /// Returns the answer to a query of the superuser, one line per row.
    pub fn sql(&self, database: &str, text: &str) -> String {
        self.ask_as(SUPERUSER, PASSWORD, database, text).unwrap_or_else(|error| panic!("{text}: {error}"))
    }

    /// Returns the answer to a query of a role, or the error.
    pub fn ask_as(&self, role: &str, password: &str, database: &str, text: &str) -> Result<String, String> {
        let mut psql = Command::new(self.bin.join("psql"));
        psql.args([
            "-X",
            "-A",
            "-t",
            "-q",
            "-v",
            "ON_ERROR_STOP=1",
            "-U",
            role,
            "-d",
            database,
            "-p",
            &self.port.to_string(),
        ]);
        psql.arg("-h").arg(self.socket()).args(["-c", text]).env("PGPASSWORD", password).stdin(Stdio::null());
        let asked = psql.output().unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap().trim_end().to_owned();
        if asked.status.success() { Ok(text(asked.stdout)) } else { Err(text(asked.stderr)) }
    }

    /// Returns a command of PostgreSQL, signed in as the superuser.
    pub fn tool(&self, name: &str) -> Command {
        let mut tool = Command::new(self.bin.join(name));
        tool.args(["-U", SUPERUSER, "-p", &self.port.to_string()]).arg("-h").arg(self.socket());
        tool.env("PGPASSWORD", PASSWORD).stdin(Stdio::null());
        tool
    }

    /// Returns the folder of the socket, which is its host.
    pub fn socket(&self) -> PathBuf {
        self.home.path().join("socket")
    }

    /// Returns the path of the socket.
    pub fn socket_file(&self) -> PathBuf {
        self.socket().join(format!(".s.PGSQL.{}", self.port))
    }

    /// Writes the password of the owner to a file.
    pub fn write_owner_password(&self, file: &Path) {
        fs::write(file, PASSWORD).unwrap();
        fs::set_permissions(file, fs::Permissions::from_mode(0o600)).unwrap();
    }

    pub fn log(&self) -> String {
        fs::read_to_string(self.home.path().join("log")).unwrap_or_default()
    }

    fn data(&self) -> PathBuf {
        self.home.path().join("data")
    }

    /// Returns true if the server accepts connections: its socket exists before it does.
    fn answers(&self) -> bool {
        UnixStream::connect(self.socket_file()).is_ok()
            && self.ask_as(SUPERUSER, PASSWORD, "postgres", "SELECT 1").is_ok()
    }

    fn give(&self, path: &Path) {
        if let Some((user, group)) = self.runs_as {
            chown(path, Some(user), Some(group)).unwrap();
        }
    }

    /// Returns a program of the server, run as the user that is allowed to.
    fn program(&self, name: &str) -> Command {
        self.as_server(self.bin.join(name))
    }

    /// Returns any program, run as the server's user.
    fn as_server(&self, path: impl AsRef<OsStr>) -> Command {
        let Some((user, group)) = self.runs_as else { return Command::new(path) };
        let mut command = Command::new("setpriv");
        command.args([format!("--reuid={user}"), format!("--regid={group}"), "--clear-groups".into(), "--".into()]);
        command.arg(path).current_dir("/");
        command
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        self.kill();
        if std::thread::panicking() {
            eprintln!("{}", self.log());
        }
    }
}

/// Returns the folder of the newest server, as Debian installs it; otherwise the one whose programs are on the PATH.
fn bin() -> PathBuf {
    let versions = fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    let newest =
        versions.filter_map(|entry| Some((entry.file_name().to_str()?.parse::<u32>().ok()?, entry.path()))).max();
    newest.map(|(_, path)| path.join("bin")).expect("Debian package postgresql")
}

/// Returns the user `postgres` if the test runs as root.
fn user() -> Option<(u32, u32)> {
    let id = |of: &str, who: &[&str]| {
        let said = Command::new("id").arg(of).args(who).output().unwrap();
        String::from_utf8(said.stdout).unwrap().trim().parse().unwrap()
    };
    (id("-u", &[]) == 0u32).then(|| (id("-u", &["postgres"]), id("-g", &["postgres"])))
}

/// Waits for a program that must succeed.
fn done(command: &mut Command) {
    let done = command.output().unwrap();
    assert!(done.status.success(), "{command:?}: {}", String::from_utf8_lossy(&done.stderr));
}
