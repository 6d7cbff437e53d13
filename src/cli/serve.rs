//! `regrind serve`: the live page of the cell and of its runs.

use std::io::{self, Read};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;
use std::time::Duration;

use clap::Args;
use regrind::config::CellConfig;
use regrind::formats::run_files::RunFile;
use regrind::recipe::Recipe;
use regrind::record::begin_of;
use regrind::setup;
use regrind_page::{Entrance, Page, Tls, UsersFile};
use tokio::net::TcpListener;

use super::Outcome;
use super::failure::Failure;

/// Default address of the page.
pub(super) const ADDRESS: &str = "127.0.0.1:7373";
/// Time for which the page stays after the end of its run, so that every browser receives the result.
const LINGERS: Duration = Duration::from_secs(3);

/// Show the cell and its runs as a page in the browser
#[derive(Args, Debug)]
#[command(after_help = "\
The page shows the active run and can give orders to this run, in the same way as `regrind hold`. Open the page on this
computer with the printed address, which contains a key. For other computers, the page needs users that sign in and a
certificate. The certificate has the names by which these computers reach the page. Alternatively, use a tunnel:
ssh -L 7373:127.0.0.1:7373 CELL (CELL is the name of this computer)

Examples:
  regrind serve --runs runs
  regrind users add \"A. Smith\" --role operator
  regrind serve --listen 0.0.0.0:7373 --certificate cell.pem --key cell.key --users users.toml

Exit codes: 0 stopped by Ctrl-C; 2 bad arguments.")]
pub(super) struct Arguments {
    /// Folder of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Address and port of the page; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS", default_value = ADDRESS)]
    listen: SocketAddr,
    #[command(flatten)]
    door: PageAccess,
    /// End after the end of standard input, that is, after the end of the program that started this one
    #[arg(long, hide = true)]
    while_stdin: bool,
}

/// Certificate and users of a page.
#[derive(Args, Debug)]
pub(super) struct PageAccess {
    /// Certificate of the page in PEM, followed by those of its issuers; required for addresses other than this
    /// computer's own. The packages support it. From source: `--features https`
    #[arg(long, value_name = "FILE", requires = "key")]
    certificate: Option<PathBuf>,
    /// Private key of the certificate in PEM; only its owner may have access
    #[arg(long, value_name = "FILE", requires = "certificate")]
    key: Option<PathBuf>,
    /// List of the users who may sign in (see `regrind users`); without it, the key of the page gives access
    #[arg(long, value_name = "FILE")]
    users: Option<PathBuf>,
}

impl PageAccess {
    /// Opens a TCP listener for the page at the address `listen`. Returns the listener and the settings for the access
    /// to the page. Returns an error if the address is in use, or if a file for the access is invalid. Also returns an
    /// error if other computers can reach the address, and the certificate or the list of users is missing.
    pub(super) async fn open(&self, listen: SocketAddr) -> Result<(TcpListener, Entrance), Failure> {
        let Self { certificate, key, users } = self;
        let tls =
            certificate.as_ref().zip(key.as_ref()).map(|(certificate, key)| Tls::read(certificate, key)).transpose()?;
        let users = users.as_ref().map(|path| UsersFile::open(path)).transpose()?;
        if !listen.ip().is_loopback() && (tls.is_none() || users.is_none()) {
            return Err(Failure::ForOthers { address: listen });
        }
        let taken = |source| Failure::Page { address: listen, source };
        let listener = TcpListener::bind(listen).await.map_err(taken)?;
        let address = listener.local_addr().map_err(taken)?;
        Ok((listener, Entrance { address, tls, users }))
    }
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let Arguments { runs, listen, door, while_stdin } = arguments;
    super::runtime()?.block_on(async {
        let (listener, entrance) = door.open(*listen).await?;
        let taken = |source| Failure::Page { address: *listen, source };
        let planned = PlannedPointsCache::default();
        let page = Page::new(
            std::path::absolute(runs).unwrap_or_else(|_| runs.clone()),
            entrance,
            Box::new(move |run| planned.points(run)),
            Box::new(|what| eprintln!("page: {what}")),
        );
        let page = page.map_err(taken)?;
        super::print(&format!("page     {}\n", page.url()))?;
        tokio::select! {
            () = page.serve(listener) => {}
            ended = tokio::signal::ctrl_c(), if !while_stdin => ended.map_err(Failure::Terminal)?,
            () = end_of_input(), if *while_stdin => tokio::time::sleep(LINGERS).await,
        }
        Ok(Outcome::Accepted)
    })
}

/// Waits until standard input is closed by all writers.
async fn end_of_input() {
    let (ended, end) = tokio::sync::oneshot::channel::<()>();
    // Own thread, which ends with the program, because a blocked read of a pipe cannot be cancelled.
    std::thread::spawn(move || {
        let mut some = [0; 64];
        while io::stdin().read(&mut some).is_ok_and(|read| read > 0) {}
        drop(ended);
    });
    drop(end.await);
}

/// Process that shows the page of a run. It ends shortly after the program that holds this value.
pub(super) struct PageProcess {
    _page: Child,
}

impl PageProcess {
    /// Starts the web page for the runs in the folder `runs` as a separate process. `listen` is the address of the
    /// page. With `json`, the process prints nothing to standard output. A separate process can neither slow down nor
    /// stop the run in this process. Returns an error if the process cannot be started.
    pub(super) fn start(runs: &Path, listen: SocketAddr, json: bool) -> Result<Self, Failure> {
        let told = if json { Stdio::null() } else { Stdio::inherit() };
        let failed = |source| Failure::Page { address: listen, source };
        let program = std::env::current_exe().map_err(failed)?;
        let mut command = Command::new(program);
        command.args(["serve", "--while-stdin", "--listen", &listen.to_string(), "--runs"]).arg(runs);
        // Ctrl-C is for the run only. If it also ended the page, the browsers would not receive the result.
        super::outside::set_apart(&mut command);
        let page = command.stdin(Stdio::piped()).stdout(told).spawn().map_err(failed)?;
        Ok(Self { _page: page })
    }
}

/// Cache of planned points: those of the run that was requested last.
#[derive(Default)]
struct PlannedPointsCache(Mutex<Option<(PathBuf, Vec<[f64; 2]>)>>);

impl PlannedPointsCache {
    fn points(&self, run: &Path) -> Option<Vec<[f64; 2]>> {
        let mut last = self.0.lock().ok()?;
        if let Some((known, points)) = &*last
            && known == run
        {
            return Some(points.clone());
        }
        let points = planned(run)?;
        *last = Some((run.to_owned(), points.clone()));
        Some(points)
    }
}

/// Returns the planned measuring points (x, y) of the run in the folder `run`, in mm in the model frame. Computes the
/// points again from the recipe and the cell file in this folder. Returns `None` if the recipe, the cell file or the
/// first record is missing or invalid.
fn planned(run: &Path) -> Option<Vec<[f64; 2]>> {
    let begin = begin_of(run).ok()?;
    let start = begin.content.part()?;
    let from = PathBuf::from(start.working_folder.as_ref()?);
    let text = |file: RunFile| std::fs::read_to_string(run.join(file.name())).ok();
    let recipe = Recipe::parse(&from.join(start.recipe.as_ref()?), &text(RunFile::Recipe)?).ok()?;
    let cell = CellConfig::parse(&from.join(start.cell.as_ref()?), &text(RunFile::Cell)?).ok()?;
    let (task, _) = setup::prepare(&recipe, &cell).ok()?;
    Some(task.targets.iter().map(|target| [target.point.x, target.point.y]).collect())
}
