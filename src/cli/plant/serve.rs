//! `regrind plant serve`: the page of all cells of a plant.

use std::net::SocketAddr;

use clap::Args;
use regrind_page::{GuardedServer as PageDoor, PageSubject};
use regrind_plant::PlantPage;

use super::super::Outcome;
use super::super::failure::Failure;
use super::super::serve::PageAccess;
use super::plant_file::{Where, database, open};

/// Default address of the page. Its port is one above that of the page of a cell.
const ADDRESS: &str = "127.0.0.1:7374";

/// Show all cells, their parts and their trends as a page in the browser
#[derive(Args, Debug)]
#[command(after_help = "\
The page gives no orders: it signs in as a reader of the plant. Open the page on this computer with the printed address,
which contains a key. For other computers, the page needs users that sign in (regrind users) and a certificate. The
certificate has the names by which these computers reach the page.

Examples:
  regrind plant enrol page --as reader --plant owner.toml --password-file page.password
  regrind plant serve --plant page.toml
  regrind plant serve --plant page.toml --listen 0.0.0.0:7374 --certificate plant.pem --key plant.key --users users.toml

Exit codes: 0 stopped by Ctrl-C; 2 bad arguments, or the database refuses the page. The page waits for a
database that cannot be reached.")]
pub(super) struct Arguments {
    /// Address and port of the page; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS", default_value = ADDRESS)]
    listen: SocketAddr,
    #[command(flatten)]
    door: PageAccess,
    #[command(flatten)]
    plant: Where,
}

pub(super) fn serve(arguments: &Arguments) -> Result<Outcome, Failure> {
    let Arguments { listen, door, plant } = arguments;
    let config = plant.read()?;
    let settings = database(&config)?.clone();
    super::super::runtime()?.block_on(async {
        match open(&config).await {
            Ok(_) => {}
            Err(Failure::Plant(error)) if error.may_pass() => {
                eprintln!("page: {error}; the page waits for the database")
            }
            Err(error) => return Err(error),
        }
        let (listener, entrance) = door.open(*listen).await?;
        let log = Box::new(|what: &str| eprintln!("page: {what}"));
        let door = PageDoor::new(entrance, PageSubject::Plant, log)
            .map_err(|source| Failure::Page { address: *listen, source })?;
        super::super::print(&format!("page     {}\n", door.url()))?;
        tokio::select! {
            () = door.serve(listener, PlantPage::new(settings, config.artefacts.clone()).routes()) => {}
            ended = tokio::signal::ctrl_c() => ended.map_err(Failure::Terminal)?,
        }
        Ok(Outcome::Accepted)
    })
}
