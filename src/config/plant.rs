//! Plant file: the name of this computer's cell in the plant, and how the plant is reached. A cell also runs without a
//! plant file.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use regrind_live::{MtConnectSettings, OpcUaSettings, SparkplugSettings};
use regrind_notify::{NotifySettings, SettingsProblem};
use regrind_plant::{Approver, ArchiveSettings, ArtefactSettings, DatabaseSettings};
use schemars::JsonSchema;
use serde::Deserialize;

use crate::document::{Document, Problems, problem_at, read_text, schema_of, sha256};

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<PlantFile>);

/// A plant of Regrind: its database, the approvers of recipes, and the receivers of live values.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct PlantFile {
    /// The plant, and this computer in it.
    #[schemars(extend("x-required" = true))]
    plant: PlantTable,
    /// The database of the plant.
    database: Option<DatabaseSettings>,
    /// People who may approve recipes: two of them must sign a recipe before this cell makes a part by it.
    #[schemars(length(max = 100))]
    approver: Vec<Approver>,
    /// Store for large files of runs. Default: the database.
    artefacts: Option<ArtefactSettings>,
    /// Archive of the runs of earlier months, for the owner of the database. Default: none.
    archive: Option<ArchiveSettings>,
    /// Broker to which the cell publishes its status. Default: none.
    sparkplug: Option<SparkplugSettings>,
    /// Server that shows the status of the cell. Default: none.
    opcua: Option<OpcUaSettings>,
    /// Adapter that shows the status of the cell to an agent of MTConnect. Default: none.
    mtconnect: Option<MtConnectSettings>,
    /// Receivers of notifications of holds, alarms and ends of runs. Default: none.
    notify: Option<NotifySettings>,
}

/// The plant, and this computer in it.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct PlantTable {
    /// Name of this cell in the plant. Omit it on a computer that belongs to no cell.
    #[schemars(length(min = 1, max = 80), example = &"cell-1")]
    cell: Option<String>,
    /// Assumed difference between machines, if it is known: the rms share of the repeatable error that is a machine's
    /// own. It counts as one comparison of this cell's machine with another, in addition to those from recipes that two
    /// machines have ground.
    #[schemars(range(min = 0.0, max = 1.0), example = 0.1)]
    machines_differ: Option<f64>,
}

/// Checked plant file.
#[derive(Clone, Debug, PartialEq)]
pub struct PlantConfig {
    /// Name of this cell in the plant. `None` on a computer that belongs to no cell.
    pub cell: Option<String>,
    /// Assumed difference between machines, if it is known.
    pub machines_differ: Option<f64>,
    /// Database of the plant. Its file paths are resolved.
    pub database: Option<DatabaseSettings>,
    /// People who can approve recipes.
    pub approvers: Vec<Approver>,
    /// Store for large files of runs.
    pub artefacts: Option<ArtefactSettings>,
    /// Archive of the runs of earlier months.
    pub archive: Option<ArchiveSettings>,
    /// Sparkplug B broker to which the status of the cell is published.
    pub sparkplug: Option<SparkplugSettings>,
    /// OPC UA server that shows the status of the cell.
    pub opcua: Option<OpcUaSettings>,
    /// Adapter that shows the status of the cell to an agent of MTConnect.
    pub mtconnect: Option<MtConnectSettings>,
    /// Receivers of notifications. Their file paths are resolved.
    pub notify: Option<NotifySettings>,
    path: PathBuf,
    text: String,
    source_sha256: [u8; 32],
}

/// Returns the JSON schema of a plant file.
pub fn plant_schema() -> &'static serde_json::Value {
    &SCHEMA
}

impl PlantConfig {
    /// Reads the plant file at `path`, and returns its checked settings.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read. Otherwise returns all errors found in its text.
    pub fn read(path: &Path) -> Result<Self, Problems> {
        Self::parse(path, &read_text(path)?)
    }

    /// Parses a plant file from its content `text`. `path` is the path of the file: it appears in error messages, and
    /// relative paths in the text are resolved against its folder.
    ///
    /// # Errors
    /// Returns all errors found in the text.
    pub fn parse(path: &Path, text: &str) -> Result<Self, Problems> {
        let mut document = Document::parse(path, text)?;
        document.check_schema(&SCHEMA);
        let written: Option<PlantFile> = document.deserialize();
        let notify = written.as_ref().and_then(|written| written.notify.as_ref());
        for SettingsProblem { key, found, allowed, remedy } in notify.map(NotifySettings::problems).unwrap_or_default()
        {
            document.report(&format!("notify.{key}"), found, allowed, remedy);
        }
        let at = path.parent().unwrap_or(Path::new(""));
        let found = written.map(
            |PlantFile { plant, database, approver, artefacts, archive, sparkplug, opcua, mtconnect, notify }| Self {
                cell: plant.cell,
                machines_differ: plant.machines_differ,
                database: database.map(|database| DatabaseSettings {
                    password_file: resolve_path(at, database.password_file),
                    certificates: resolve_path(at, database.certificates),
                    ..database
                }),
                approvers: approver,
                artefacts: artefacts.map(|kept| ArtefactSettings { folder: at.join(kept.folder), ..kept }),
                archive: archive.map(|kept| ArchiveSettings { folder: at.join(kept.folder), ..kept }),
                sparkplug: sparkplug.map(|broker| SparkplugSettings {
                    password_file: resolve_path(at, broker.password_file),
                    certificates: resolve_path(at, broker.certificates),
                    ..broker
                }),
                opcua,
                mtconnect,
                notify: notify.map(|notify| notify.resolved(at)),
                path: path.to_owned(),
                text: text.to_owned(),
                source_sha256: sha256(text),
            },
        );
        document.finish()?;
        found.ok_or_else(|| {
            Problems::whole(path, text, "a required value is missing".into(), "compare it with config/plant/plant.toml")
        })
    }

    /// Builds an error report about one key of this plant file, for an error that another module has found. The report
    /// shows the position of `key` in the file. `found` describes the present value, `allowed` the permitted values,
    /// and `remedy` the action that corrects the error.
    pub fn problem(&self, key: &str, found: &str, allowed: &str, remedy: &str) -> Problems {
        problem_at(&self.path, &self.text, &[], key, [found, allowed, remedy])
    }

    /// Returns the path of the plant file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the SHA-256 of the text of the plant file.
    pub fn source_sha256(&self) -> &[u8; 32] {
        &self.source_sha256
    }
}

/// Returns the path `file` resolved against the folder `at` of the plant file; an absolute path is unchanged. Returns
/// `None` if `file` is `None`.
fn resolve_path(at: &Path, file: Option<PathBuf>) -> Option<PathBuf> {
    file.map(|file| at.join(file))
}
