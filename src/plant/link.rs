//! Connection to the database: role, authentication of both ends, and timeouts.

use std::time::Duration;

use regrind_document::visible_line;
use regrind_trust::{CertificateFault, certificate_fault};
use serde_json::Value;
use tokio_postgres::config::SslMode;
use tokio_postgres::types::ToSql;
use tokio_postgres::{Client, Config, NoTls, Row};
use tokio_postgres_rustls::MakeRustlsConnect;

use super::error::{PlantError, in_words, passing, refused};
use super::settings::DatabaseSettings;

/// Timeouts to connect to the database, and to get an answer.
const PATIENCE: Duration = Duration::from_secs(10);
const ANSWER: Duration = Duration::from_secs(120);
/// Time after which a connection to a dead peer is closed.
const SILENCE: Duration = Duration::from_secs(30);

/// Connection to the database of a plant. It closes when the last owner drops it.
pub struct DatabaseLink {
    client: Client,
    /// Address, for messages.
    place: String,
}

impl DatabaseLink {
    /// Connects to the database of the plant and signs in with the values in `settings`.
    ///
    /// # Errors
    /// A password or a certificate cannot be read. The database is on another computer and no certificates are given.
    /// The database refuses the sign-in, or cannot be reached.
    pub async fn open(settings: &DatabaseSettings) -> Result<Self, PlantError> {
        let place = format!("{}:{}/{}", settings.host, settings.port, settings.name);
        let proof = regrind_trust::tls_config(&settings.host, settings.certificates.as_deref(), "[database]")?;
        let config = config(settings, proof.is_some())?;
        let unreached = |what: String| PlantError::Unreachable { place: place.clone(), what };
        let late = |_| unreached(format!("no answer within {} s", PATIENCE.as_secs()));
        let client = match proof {
            Some(proof) => {
                let opened = tokio::time::timeout(PATIENCE, config.connect(MakeRustlsConnect::new(proof)))
                    .await
                    .map_err(late)?;
                let (client, connection) = opened.map_err(|error| unopened(&place, &error))?;
                tokio::spawn(connection);
                client
            }
            None => {
                let opened = tokio::time::timeout(PATIENCE, config.connect(NoTls)).await.map_err(late)?;
                let (client, connection) = opened.map_err(|error| unopened(&place, &error))?;
                tokio::spawn(connection);
                client
            }
        };
        Ok(Self { client, place })
    }

    /// Returns the database client, for queries.
    pub fn client(&self) -> &Client {
        &self.client
    }

    /// Returns the database client as a mutable reference. A transaction needs one.
    pub fn client_mut(&mut self) -> &mut Client {
        &mut self.client
    }

    /// Runs the SQL query `text` and returns the rows. `values` are the values of its parameters `$1`, `$2` and so on.
    ///
    /// # Errors
    /// The database cannot be reached, or refuses the query.
    pub async fn query(&self, text: &str, values: &[&(dyn ToSql + Sync)]) -> Result<Vec<Row>, PlantError> {
        self.client.query(text, values).await.map_err(refused("the query"))
    }

    /// Reports the state of the cell to the plant. `run` is the name of the active run; `None` without an active run.
    ///
    /// # Errors
    /// The database cannot be reached, or refuses the report.
    pub async fn report_state(&self, run: Option<&str>, snapshot: &Value) -> Result<(), PlantError> {
        let told = self.client.execute("SELECT tell_state($1, $2::text::jsonb)", &[&run, &snapshot.to_string()]).await;
        told.map(drop).map_err(refused("the state of the cell"))
    }

    /// Returns true if the connection to the database is closed.
    pub fn is_closed(&self) -> bool {
        self.client.is_closed()
    }

    /// Returns the address of the database for messages, as `host:port/database`.
    pub fn place(&self) -> &str {
        &self.place
    }
}

/// Converts `error`, an error of the connection to the database, into a [`PlantError`]. A wrong password or user name
/// and a missing database become [`PlantError::Refused`], and a certificate that proves nothing becomes
/// [`PlantError::Certificate`]. A server that tells of a limit or a fault becomes [`PlantError::DatabaseFault`]. Every
/// other error becomes [`PlantError::Unreachable`] with the address `place`.
fn unopened(place: &str, error: &tokio_postgres::Error) -> PlantError {
    if let Some(CertificateFault { what, remedy }) = certificate_fault(error) {
        return PlantError::Certificate { place: place.to_owned(), what, remedy };
    }
    if in_words(error).contains("does not support TLS") {
        let remedy = "give the server a certificate (`ssl = on`), as docs/plant.md makes it";
        return PlantError::Certificate { place: place.to_owned(), what: "it has no certificate".to_owned(), remedy };
    }
    match error.as_db_error() {
        // Classes 28 (invalid authorisation), 3D and 42 (no such database or role).
        Some(said) if ["28", "3D", "42"].iter().any(|class| said.code().code().starts_with(class)) => {
            PlantError::Refused {
                what: "the login of this computer",
                reason: visible_line(said.message()),
                hint: "; check name, user and password of [database]".into(),
            }
        }
        said => {
            let passing = said.and_then(|said| passing(place, said.code().code(), said.message()));
            passing.unwrap_or_else(|| PlantError::Unreachable { place: place.to_owned(), what: in_words(error) })
        }
    }
}

fn config(settings: &DatabaseSettings, is_proven: bool) -> Result<Config, PlantError> {
    let DatabaseSettings { host, port, name, user, password_file, .. } = settings;
    let mut config = Config::new();
    config.host(host).port(*port).dbname(name).user(user).application_name("regrind");
    config.ssl_mode(if is_proven { SslMode::Require } else { SslMode::Disable });
    config
        .connect_timeout(PATIENCE)
        .tcp_user_timeout(SILENCE)
        .keepalives_idle(SILENCE / 2)
        .keepalives_interval(SILENCE / 6);
    config.options(format!(
        "-c search_path=regrind,pg_temp -c statement_timeout={} -c idle_in_transaction_session_timeout={} -c timezone=UTC",
        ANSWER.as_millis(),
        ANSWER.as_millis()
    ));
    if let Some(path) = password_file {
        config.password(regrind_trust::read_password(path)?);
    }
    Ok(config)
}
