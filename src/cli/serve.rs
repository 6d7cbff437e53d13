//! `regrind serve`: the live page of the cell and of its runs.

use std::io::{self, IsTerminal, Read, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use clap::Args;
use regrind::config::BUILT_IN_CELL;
use regrind_page::{Entrance, Page, Tls, UsersFile, Viewers};
use tokio::net::TcpListener;

use super::Outcome;
use super::failure::Failure;
use super::outside::Endings;
use super::run_plan::RunPlans;
use super::workbench::workbench;

/// Default address of the page.
pub(super) const ADDRESS: &str = "127.0.0.1:7373";
/// Time for which the page stays after the end of its run if no browser shows it, so that a browser that is about to
/// open it receives the result.
const STAYS_UNSEEN: Duration = Duration::from_secs(3);
/// Time for which the page stays after the last browser has left.
const STAYS_SEEN: Duration = Duration::from_secs(60);

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
    /// Folder of the recipes that an engineer writes on the page; `recipes` if it exists
    #[arg(long, value_name = "DIR")]
    recipes: Option<PathBuf>,
    /// Cell for which recipes are planned; `sim` is the built-in simulated cell
    #[arg(long, value_name = "FILE", default_value = BUILT_IN_CELL)]
    cell: PathBuf,
    #[command(flatten)]
    door: PageAccess,
    /// End after the end of standard input, that is, after the end of the program that started this one
    #[arg(long, hide = true)]
    while_stdin: bool,
    /// Name of the run that the first page shows
    #[arg(long, value_name = "RUN", hide = true)]
    first_run: Option<String>,
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
    let Arguments { runs, listen, recipes, cell, door, while_stdin, first_run } = arguments;
    let workbench = workbench(recipes.as_deref(), cell)?;
    super::runtime()?.block_on(async {
        let (listener, entrance) = door.open(*listen).await?;
        if !runs.is_dir() {
            return Err(Failure::NoRunsFolder { path: runs.clone() });
        }
        let taken = |source| Failure::Page { address: *listen, source };
        let page = Page::new(
            std::path::absolute(runs).unwrap_or_else(|_| runs.clone()),
            entrance,
            Box::new(RunPlans::default()),
            Box::new(|what| eprintln!("page: {what}")),
        );
        let page = page.map_err(taken)?.with_first_run(first_run.clone()).with_workbench(workbench);
        let viewers = page.viewers();
        // A page that ends in order ends its simulation and deletes its folder. The page of a run has neither, and a signal
        // ends it at once.
        let mut endings = (!while_stdin).then(Endings::new).transpose().map_err(Failure::Terminal)?;
        super::print(&format!("page     {}\n", page.url()))?;
        tokio::select! {
            () = page.serve(listener) => {}
            ended = tokio::signal::ctrl_c(), if !while_stdin => ended.map_err(Failure::Terminal)?,
            _ = async { endings.as_mut()?.next().await }, if !while_stdin => {}
            () = end_of_run(&viewers), if *while_stdin => {}
        }
        Ok(Outcome::Accepted)
    })
}

/// Waits until the program that started this one has ended its run, and then until no browser shows the page any more.
/// If that program ended in another way, the page ends soon.
async fn end_of_run(viewers: &Viewers) {
    let has_ended_well = end_of_input().await;
    if !has_ended_well {
        tokio::time::sleep(STAYS_UNSEEN).await;
    } else if tokio::time::timeout(STAYS_UNSEEN, viewers.come()).await.is_ok() {
        viewers.gone(STAYS_SEEN).await;
    }
}

/// Waits until standard input is closed by all writers. Returns true if it had any content.
async fn end_of_input() -> bool {
    let (ended, end) = tokio::sync::oneshot::channel();
    // Own thread, which ends with the program, because a blocked read of a pipe cannot be cancelled.
    std::thread::spawn(move || {
        let mut some = [0; 64];
        let mut has_content = false;
        while io::stdin().read(&mut some).is_ok_and(|read| read > 0) {
            has_content = true;
        }
        ended.send(has_content)
    });
    end.await.unwrap_or(false)
}

/// Process that shows the page of a run. It ends soon after the program that holds this value, unless it is told to
/// stay.
pub(super) struct PageProcess {
    page: Child,
}

impl PageProcess {
    /// Starts the web page for the runs in the folder `runs` as a separate process. The first page shows the run in
    /// `folder`. `listen` is the address of the page. With `json`, the process prints nothing to standard output. A
    /// separate process can neither slow down nor stop the run in this process. Returns an error if the process cannot
    /// be started.
    pub(super) fn start(runs: &Path, folder: &Path, listen: SocketAddr, json: bool) -> Result<Self, Failure> {
        let told = if json { Stdio::null() } else { Stdio::inherit() };
        let failed = |source| Failure::Page { address: listen, source };
        let program = std::env::current_exe().map_err(failed)?;
        let mut command = Command::new(program);
        command.args(["serve", "--while-stdin", "--listen", &listen.to_string(), "--runs"]).arg(runs);
        if let Some(name) = folder.file_name() {
            command.arg("--first-run").arg(name);
        }
        // Ctrl-C is for the run only. If it also ended the page, the browsers would not receive the result.
        super::outside::set_apart(&mut command);
        let page = command.stdin(Stdio::piped()).stdout(told).spawn().map_err(failed)?;
        Ok(Self { page })
    }

    /// Keeps the page after the end of the run: on a terminal until Ctrl-C, elsewhere for as long as a browser shows it
    /// and for some time after. Ctrl-C, SIGTERM and a closed terminal end it in any case. The page has no effect on the
    /// result of the run, so its errors are ignored.
    pub(super) async fn stay(mut self, json: bool) {
        let Ok(mut endings) = Endings::new() else { return };
        let is_attended = io::stdin().is_terminal() && io::stdout().is_terminal() && !json;
        let page = &mut self.page;
        let shown = async {
            if !json {
                let until = if is_attended { "until Ctrl-C" } else { "until 60 s after the last browser has left" };
                let _ = super::print(&format!("page     stays {until}\n"));
            }
            if !is_attended && let Some(mut input) = page.stdin.take() {
                let _ = input.write_all(b"stay\n");
            }
            ended(page).await;
        };
        tokio::select! {
            // The handler of Ctrl-C is in place before the message.
            biased;
            _ = tokio::signal::ctrl_c() => {}
            _ = endings.next() => {}
            () = shown => {}
        }
        // It may have ended by itself.
        let _ = self.page.kill();
        let _ = self.page.wait();
    }
}

/// Waits until a process has ended.
async fn ended(process: &mut Child) {
    let mut polls = tokio::time::interval(Duration::from_millis(100));
    while process.try_wait().is_ok_and(|status| status.is_none()) {
        polls.tick().await;
    }
}
