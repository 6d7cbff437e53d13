//! Settings in a cell file of a machine that is reached by files, and the machines that are made from it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::cmm::{CmmExchange, CmmFolders, StationFiles, Stations};
use super::grinder::{GrinderExchange, GrinderFolders};
use super::machine::ExchangeMachine;
use super::pattern::Pattern;
use crate::MachineKind;
use crate::driver_factory::{DriverContext, DriverError, DriverFactory};
use crate::machine_table::MachineTable;
use regrind_document::Document;
use regrind_formats::references::read_references;
use regrind_formats::result::{Content, Coordinates, DecimalMark};
use regrind_formats::{Columns, Unit};

/// Timeout for a folder, which may be on another computer, including the read of a large file.
const FOLDER_TIMEOUT: Duration = Duration::from_secs(30);

/// Files in two folders, and a person.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ExchangeWire {
    /// Folder into which Regrind writes the jobs of the machine; relative to this file.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "exchange/cmm/out")]
    pub outbox: String,
    /// Folder in which results appear; relative to this file.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "exchange/cmm/in")]
    pub inbox: String,
    /// Time without a change after which a file is complete.
    #[schemars(range(min = 0.05, max = 3600.0))]
    pub stable_for_s: f64,
    /// Meaning of the coordinates of results, if the files do not state it; coordinates without a stated meaning are
    /// refused.
    pub coordinates: Option<Coordinates>,
    /// Decimal mark of results.
    pub decimal: DecimalMark,
    /// Unit of length of results.
    pub unit: Unit,
    /// Unit of length of z in a table, if it differs from that of x and y.
    pub height_unit: Option<Unit>,
    /// Distance of the samples of a map of heights, if the map does not state it.
    #[schemars(range(min = 1e-6, max = 100.0))]
    pub sample_spacing_mm: Option<f64>,
    /// Columns of x, y and z in results, if their headers do not identify them: `x=NAME,y=NAME,z=NAME`, names or
    /// numbers from 1.
    #[schemars(length(min = 5, max = 200), example = &"x=X_act,y=Y_act,z=Z_act")]
    pub columns: Option<Columns>,
    /// Stations of a measurement, each with its own frame.
    #[schemars(length(max = 64))]
    pub stations: Vec<StationTable>,
    /// File of the reference points in the CMM frame, to which stations are merged; relative to this file.
    #[schemars(length(min = 1, max = 400))]
    pub reference_points: Option<String>,
    /// Name of the group of reference points within the file.
    #[schemars(length(min = 1, max = 80))]
    pub reference_group: Option<String>,
    /// Maximum residual of a reference point after the best fit of its station.
    #[schemars(range(min = 0.0001, max = 100.0))]
    pub reference_limit_mm: f64,
    /// Names of result files: `{part}`, `{job}` and `{cycle}` are filled in, and one `*` matches any characters.
    #[schemars(length(min = 1, max = 200))]
    pub result: String,
    /// Whether to accept files that were in the inbox before the plan was handed over.
    pub accept_earlier_files: bool,
    /// Maximum difference between the probe radius in a file and that of the recipe.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub probe_tolerance_mm: f64,
    /// Sensor of the machine, by its name in DMIS. With this key, the plan is also written as a DMIS program,
    /// `plan.dmi`, which recalls and selects the sensor.
    #[schemars(length(min = 1, max = 40), example = &"PROBE6")]
    pub dmis_sensor: Option<String>,
    /// Whether the machine is separate and cannot reach the part at the other machine. If true, no person is asked
    /// whether it is clear.
    pub cannot_reach_part: bool,
}

impl Default for ExchangeWire {
    fn default() -> Self {
        Self {
            outbox: String::new(),
            inbox: String::new(),
            stable_for_s: 2.0,
            coordinates: None,
            decimal: DecimalMark::Auto,
            unit: Unit::Millimetre,
            height_unit: None,
            sample_spacing_mm: None,
            columns: None,
            stations: Vec::new(),
            reference_points: None,
            reference_group: None,
            reference_limit_mm: 0.1,
            result: "{part}_c{cycle}.*".to_owned(),
            accept_earlier_files: false,
            probe_tolerance_mm: 0.001,
            dmis_sensor: None,
            cannot_reach_part: false,
        }
    }
}

/// A station of a measurement.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StationTable {
    /// File of its points in the inbox; one `*` matches any characters.
    #[schemars(length(min = 1, max = 200), extend("x-required" = true), example = "M1_*.txt")]
    pub points: String,
    /// File of the reference points as the station measures them, in the inbox; `*` matches the same characters.
    #[schemars(length(min = 1, max = 200), extend("x-required" = true), example = "ref_*.yaml")]
    pub reference: String,
}

impl DriverFactory for ExchangeWire {
    type Cmm = ExchangeMachine<CmmFolders>;
    type Grinder = ExchangeMachine<GrinderFolders>;
    const BY_PERSON: bool = true;
    const READS_RUN_FOLDER: bool = true;

    fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
        if self.outbox == self.inbox && !self.outbox.is_empty() {
            let allowed = "the outbox and the inbox must be different folders";
            document.report(&place.key("wire.inbox"), "is the same folder as `outbox`", allowed, "give each a folder");
        }
        self.check_result(place, document);
        self.check_stations(place, document);
        self.check_dmis(place, document);
    }

    fn check_against_grinder(&self, grinder: &Self, document: &mut Document) {
        if self.inbox == grinder.inbox && !self.inbox.is_empty() {
            let allowed = "each machine requires its own results";
            document.report("grinder.wire.inbox", "is the inbox of the CMM too", allowed, "give each machine its own");
        }
    }

    fn coordinates(&self) -> Option<Coordinates> {
        self.coordinates
    }

    fn create_cmm(&self, context: &DriverContext<'_>) -> Result<Self::Cmm, DriverError> {
        let [outbox, inbox] = self.folders(context, MachineKind::Cmm)?;
        let settings = CmmExchange {
            stable_for: Duration::from_secs_f64(self.stable_for_s),
            content: Content {
                coordinates: self.coordinates,
                decimal: self.decimal,
                unit: self.unit,
                height_unit: self.height_unit,
                sample_spacing_mm: self.sample_spacing_mm,
                columns: self.columns.clone(),
            },
            result: Pattern::new(&*self.result),
            stations: self.stations(context)?,
            free_count: context.min_free_points.is_some(),
            min_points: context.min_free_points.unwrap_or(1),
            min_coverage: context.min_coverage,
            rehearsal: context.rehearsal,
            accept_earlier_files: self.accept_earlier_files,
            probe_tolerance_mm: self.probe_tolerance_mm,
            dmis_sensor: self.dmis_sensor.clone(),
            ..CmmExchange::new(context.part, outbox, &inbox)
        };
        Ok(self.machine(MachineKind::Cmm, &inbox, CmmFolders::new(settings)))
    }

    fn create_grinder(&self, context: &DriverContext<'_>) -> Result<Self::Grinder, DriverError> {
        let [outbox, inbox] = self.folders(context, MachineKind::Grinder)?;
        let stable_for = Duration::from_secs_f64(self.stable_for_s);
        let run_folder = context.run_folder.to_owned();
        let settings =
            GrinderExchange { part: context.part.to_owned(), outbox, inbox: inbox.clone(), run_folder, stable_for };
        Ok(self.machine(MachineKind::Grinder, &inbox, GrinderFolders::new(settings)))
    }
}

impl ExchangeWire {
    fn machine<M: super::Exchange>(&self, kind: MachineKind, inbox: &Path, folders: M) -> ExchangeMachine<M> {
        let name = format!("{} by files, {}", kind.name(), inbox.display());
        ExchangeMachine::new(name, kind, folders, FOLDER_TIMEOUT).apart(self.cannot_reach_part)
    }

    /// Returns the paths of two folders: the outbox, to which this program writes hand-overs, and the inbox, in which
    /// the answers appear. `machine` is used for the error text.
    ///
    /// # Errors
    /// Returns an error if one of the two folders does not exist. Regrind does not create them, because no machine or
    /// person would use a folder that Regrind created itself.
    fn folders(&self, context: &DriverContext<'_>, machine: MachineKind) -> Result<[PathBuf; 2], DriverError> {
        let table = machine.name();
        let folder = |name: &str, path: &String| {
            let path = context.cell_folder.join(path);
            match path.is_dir() {
                true => Ok(path),
                false => Err(DriverError::Folder { key: format!("{table}.wire.{name}"), path, machine }),
            }
        };
        Ok([folder("outbox", &self.outbox)?, folder("inbox", &self.inbox)?])
    }

    /// Returns the settings for a measurement from several stations, each with its own frame. Returns `None` if the
    /// cell file names no file of reference points.
    ///
    /// Reads the file of reference points now, so that an error in this file is found before the measurement begins.
    /// Returns an error if the file is not valid.
    fn stations(&self, context: &DriverContext<'_>) -> Result<Option<Stations>, DriverError> {
        let Some(nominal) = self.reference_points.as_ref().map(|file| context.cell_folder.join(file)) else {
            return Ok(None);
        };
        let group = self.reference_group.clone();
        read_references(&nominal, group.as_deref())
            .map_err(|source| DriverError::References { source: Box::new(source) })?;
        let files = self.stations.iter().map(|station| StationFiles {
            points: Pattern::new(&*station.points),
            references: Pattern::new(&*station.reference),
        });
        Ok(Some(Stations { files: files.collect(), nominal, group, limit_mm: self.reference_limit_mm }))
    }

    fn check_result(&self, place: &MachineTable<'_>, document: &mut Document) {
        let name = &self.result;
        let mut plain = name.to_owned();
        for word in ["{part}", "{job}", "{cycle}"] {
            plain = plain.replace(word, "");
        }
        if plain.contains(['/', '\\', '{', '}']) || plain.matches('*').count() > 1 {
            let allowed =
                "the value must be a file name without a folder; `{part}`, `{job}`, `{cycle}` and one `*` are allowed";
            let remedy = "the usual name is \"{part}_c{cycle}.*\"";
            document.report(&place.key("wire.result"), format!("is {name:?}"), allowed, remedy);
        }
    }

    fn check_dmis(&self, place: &MachineTable<'_>, document: &mut Document) {
        let Some(sensor) = &self.dmis_sensor else { return };
        let key = place.key("wire.dmis_sensor");
        if place.table == "grinder" {
            let allowed = "a grinder has no measuring program";
            return document.report(&key, "is given for a grinder", allowed, "remove it");
        }
        if !sensor.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-')) {
            let allowed = "a DMIS label has only letters, digits, _ and -";
            document.report(&key, format!("is {sensor:?}"), allowed, "write it as in S(...)");
        }
        if self.coordinates.is_none() {
            let allowed = "the DMIS program must state whether the points are probe centres or contact points";
            document.report(
                &place.key("wire.coordinates"),
                "is missing; `dmis_sensor` requires it",
                allowed,
                "write centres or contacts",
            );
        }
    }

    fn check_stations(&self, place: &MachineTable<'_>, document: &mut Document) {
        let (stations, reference) = (place.key("wire.stations"), place.key("wire.reference_points"));
        match (self.stations.is_empty(), self.reference_points.is_some()) {
            (false, false) if !document.has_problem(&reference) => {
                let allowed = "stations are merged by reference points";
                document.report(&stations, "have no `reference_points`", allowed, "name their file");
            }
            (true, true) if !document.has_problem(&stations) => {
                let allowed = "reference points are used only to merge stations";
                document.report(&reference, "is given without stations", allowed, "add [[cmm.wire.stations]]");
            }
            _ => {}
        }
        for (k, StationTable { points, reference }) in self.stations.iter().enumerate() {
            if points.is_empty() || reference.is_empty() {
                continue; // reported by the schema
            }
            let stars = [points, reference].map(|name| name.matches('*').count());
            for (name, key) in [(points, "points"), (reference, "reference")] {
                let key = place.key(&format!("wire.stations[{k}].{key}"));
                if name.contains(['/', '\\']) || name.matches('*').count() > 1 {
                    let allowed = "the value must be a file name without a folder, with at most one `*`";
                    document.report(&key, format!("is {name:?}"), allowed, "remove the folder");
                }
            }
            if stars[0] != stars[1] && stars[0].max(stars[1]) == 1 {
                let key = place.key(&format!("wire.stations[{k}].reference"));
                let found = format!("is {reference:?}, and `points` is {points:?}");
                document.report(&key, found, "use `*` in both `points` and `reference`, or in neither", "add the `*`");
            }
        }
    }
}
