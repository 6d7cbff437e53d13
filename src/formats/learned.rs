//! Knowledge of the grinder that a finished run saves for the next part of the same kind.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::FormatError;
use super::run_files::RunFile;
use super::whole::read_whole;
use regrind_core::compensation::{
    Correction, LearningState, MachineSimilarity, ParameterCorrections, TransferredState, contradicting_machines,
};
use regrind_core::model::PartPriors;

/// Maximum size of the file, in bytes; a larger file is not one of Regrind's.
const MAX_BYTES: u64 = 256 << 20;

/// Version of the file's layout; a file of another version is not read.
const LAYOUT: u32 = 2;

/// Correction that compensates the error common to all passes, and its uncertainty.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    layout: u32,
    /// True if the passes were simulated.
    pub simulation: bool,
    /// Setting that the passes had in common; a run with another setting learns nothing from this file.
    pub setting: String,
    /// Run from which the correction was learned.
    pub run: String,
    /// Correction that the next pass of that part would have had.
    pub correction: Correction,
    /// State of learning: the estimate of the error common to all passes, with its uncertainty.
    pub known: LearningState,
    /// Priors of the error fields, learned from this part and those before it; absent in files of earlier versions.
    #[serde(default)]
    pub fields: PartPriors,
    /// Kind of these passes: another cell can begin with this file only if its passes are of the same kind. Absent in
    /// files of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<String>,
    /// Cells that the knowledge comes from, if it is from other cells and not from a run of this one.
    #[serde(rename = "taught_by", default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<KnowledgeOrigin>,
}

/// Origin of the knowledge that a first part begins with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KnowledgeOrigin {
    /// Cells, and the run of each.
    pub runs: Vec<CellRun>,
    /// For each band of wavelengths that was taken over: its shortest wavelength, in millimetres, and the rms share of
    /// the repeatable error in it that is assumed to be specific to a machine.
    #[serde(rename = "differ")]
    pub machine_difference: Vec<[f64; 2]>,
    /// Number of comparisons between machines on which this is based.
    pub comparisons: usize,
}

/// Identity of settings that two runs must share so that one can learn from the other.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SettingIdentity {
    /// Name and hash of a versioned document of the settings. It is written into records and files.
    pub id: String,
    /// Text that versions up to 0.2 wrote for the same settings. It is only compared.
    pub earlier: String,
}

impl SettingIdentity {
    /// Returns true if `recorded` identifies the same settings. `recorded` is from a file or a record of this or of an
    /// earlier version.
    pub fn fits(&self, recorded: &str) -> bool {
        recorded == self.id || recorded == self.earlier
    }

    /// Returns the identity of these settings together with the seed of another simulated part.
    #[must_use]
    pub fn with_seed(self, seed: u64) -> Self {
        Self { id: format!("{}, seed {seed}", self.id), earlier: format!("{}, seed {seed}", self.earlier) }
    }
}

/// Run of a cell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CellRun {
    /// Name of the cell in the plant.
    pub cell: String,
    /// Name of the run.
    pub run: String,
}

/// Fields of a file that are read first and decide if the rest is read.
#[derive(Deserialize)]
struct Head {
    #[serde(default)]
    layout: u32,
    simulation: bool,
    setting: String,
}

/// Reason why nothing is learned from a file.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum LearnedError {
    #[error(transparent)]
    File(#[from] FormatError),
    #[error("{path}: this file cannot be used: {reason}; copy the folder of this run from the archive again")]
    Broken { path: PathBuf, reason: String },
}

impl Learned {
    /// Creates the knowledge of a finished run: the learned correction and the state of the learning. The next part of
    /// the same kind begins with this knowledge.
    ///
    /// `run` is the name of the run. `correction` is the correction that the run would use for one more pass. `known`
    /// is the state of the learning: the estimated error common to all passes, with its uncertainty. `setting` is a
    /// text of settings; another run can use this knowledge only if its own text is equal. `simulation` is true if the
    /// passes were simulated.
    pub fn new(simulation: bool, setting: String, run: String, correction: Correction, known: LearningState) -> Self {
        let (fields, kind, taught_by) = (PartPriors::default(), None, None);
        Self { layout: LAYOUT, simulation, setting, run, correction, known, fields, kind, origin: taught_by }
    }

    /// Predicts the knowledge (the learned correction and the state of the learning) for the first part of a recipe on
    /// a machine that has not ground this recipe yet. `others` holds runs on other machines, each with its knowledge.
    /// `alike` is the similarity of the machines. `fresh` is the state of the learning of this machine before the first
    /// pass. `none` is the correction of 0 for the new part.
    ///
    /// `simulation` and `setting` are stored in the result. `simulation` is true if the passes of this machine are
    /// simulated. `setting` is the text of settings that must be equal in a run that uses the result.
    ///
    /// The learning treats the error of the surface separately in several bands of wavelengths. Returns `None` if no
    /// run in `others` has learned an error in the same bands as `fresh`.
    ///
    /// The parameter corrections of another machine (such as the correction of its wheel radius) do not apply to this
    /// machine. Therefore the result contains none, and its correction map compensates the complete predicted error.
    pub fn from_others(
        others: &[(CellRun, Self)],
        alike: &MachineSimilarity,
        (simulation, setting): (bool, String),
        (fresh, none): (&LearningState, Correction),
    ) -> Option<Self> {
        let known: Vec<&LearningState> = others.iter().map(|(_, other)| &other.known).collect();
        let TransferredState { state: known, own_shares: differ } = fresh.seeded_from(&known, alike, none.grid)?;
        let runs: Vec<CellRun> = others.iter().map(|(from, _)| from.clone()).collect();
        let fields: Vec<PartPriors> = others.iter().map(|(_, other)| other.fields).collect();
        let named: Vec<String> = runs.iter().map(|CellRun { cell, run }| format!("{run} of {cell}")).collect();
        let correction = none.compensating(&known, None);
        let taught_by = Some(KnowledgeOrigin { runs, machine_difference: differ, comparisons: alike.comparisons() });
        let learned = Self::new(simulation, setting, named.join(" and "), correction, known);
        Some(Self { origin: taught_by, ..learned.with_fields(PartPriors::pooled(&fields)) })
    }

    /// Returns, for each of `others`, true if its learned error contradicts those of most others
    /// ([`contradicting_machines`]). All must be for the same kind of parts, each from another cell.
    pub fn contradicting(others: &[(CellRun, Self)]) -> Vec<bool> {
        contradicting_machines(&others.iter().map(|(_, other)| &other.known).collect::<Vec<_>>())
    }

    /// Returns this knowledge of a run with `kind` stored in it. `kind` is a text of those settings of the run that do
    /// not belong to the cell. A run of another cell can begin with this knowledge only if its own text is equal.
    #[must_use]
    pub fn with_kind(self, kind: String) -> Self {
        Self { kind: Some(kind), ..self }
    }

    /// Returns this knowledge of a run with its statistics of the error model replaced by `fields`. These statistics
    /// summarise the hyperparameters (such as the range of the covariance function) that were estimated for earlier
    /// parts. The next part uses them as prior distributions.
    #[must_use]
    pub fn with_fields(self, fields: PartPriors) -> Self {
        Self { fields, ..self }
    }

    /// Reads the knowledge that a finished run saved in its folder `run`. Returns the knowledge (the learned correction
    /// and the state of the learning) and the bytes of its file.
    ///
    /// `setting` is the identity of the settings of the new run. `simulation` is true if the passes of the new run are
    /// simulated. Each must fit the value in the file.
    ///
    /// Returns `None` if the file does not exist, has another version of the layout, or has another `setting` or
    /// another value of `simulation`.
    ///
    /// # Errors
    /// A file that cannot be read, is too large, is not written by Regrind, or has an impossible number.
    pub fn read(
        run: &Path,
        setting: &SettingIdentity,
        simulation: bool,
    ) -> Result<Option<(Self, Vec<u8>)>, LearnedError> {
        let path = run.join(RunFile::Learned.name());
        let broken = |reason| LearnedError::Broken { path: path.clone(), reason };
        let text = match read_whole(&path, MAX_BYTES) {
            Ok(text) => text,
            Err(FormatError::Unreadable { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
                return Ok(None);
            }
            Err(FormatError::TooLarge { found, .. }) => {
                return Err(broken(format!("{found} bytes, more than the limit of {MAX_BYTES}")));
            }
            Err(error) => return Err(error.into()),
        };
        // The head is read first: a file of another part or of an earlier version is ignored without an error.
        let head: Head = serde_json::from_slice(&text).map_err(|error| broken(error.to_string()))?;
        if head.layout != LAYOUT || head.simulation != simulation || !setting.fits(&head.setting) {
            return Ok(None);
        }
        Self::from_saved(&path, &text).map(|learned| Some((learned, text)))
    }

    /// Parses the knowledge of a run of another cell (the learned correction and the state of the learning) from
    /// `text`, the content of its file. `from` only names the file in messages.
    ///
    /// `kind` is the identity of the settings of the new run, without the settings that belong to its cell. `simulation`
    /// is true if the passes of this cell are simulated. Each must fit the value in `text`.
    ///
    /// # Errors
    /// - Regrind did not write `text`, or `text` contains an impossible number.
    /// - The knowledge has another `kind`, another value of `simulation` or another version of the layout.
    /// - The other cell did not learn the knowledge in its own run, but took it from other cells.
    /// - The state of the learning cannot be transferred to another machine.
    pub fn read_other(
        from: &Path,
        text: &[u8],
        kind: &SettingIdentity,
        simulation: bool,
    ) -> Result<Self, LearnedError> {
        let learned = Self::from_saved(from, text)?;
        let is_meant = learned.layout == LAYOUT
            && learned.kind.as_deref().is_some_and(|recorded| kind.fits(recorded))
            && learned.simulation == simulation
            && learned.origin.is_none();
        let broken = |reason| Err(LearnedError::Broken { path: from.to_owned(), reason });
        match learned.known.transfer_obstacle() {
            _ if !is_meant => broken("the knowledge is for another kind of parts than this recipe".into()),
            Some(reason) => broken(reason),
            None => Ok(learned),
        }
    }

    /// Parses the knowledge of a run (the learned correction and the state of the learning) from `text`, the content of
    /// its file. The file can be a copy that a later run saved at its start. `path` only names the file in messages.
    ///
    /// # Errors
    /// A text that Regrind did not write, or that has an impossible number.
    pub fn from_saved(path: &Path, text: &[u8]) -> Result<Self, LearnedError> {
        let broken = |reason| LearnedError::Broken { path: path.to_owned(), reason };
        let learned: Self = serde_json::from_slice(text).map_err(|error| broken(error.to_string()))?;
        match learned.flaw() {
            None => Ok(learned),
            Some(reason) => Err(broken(reason)),
        }
    }

    /// Returns a description of the first impossible value in this knowledge, such as a correction that is not finite.
    /// Returns `None` if all values are possible.
    fn flaw(&self) -> Option<String> {
        let Correction { grid, values_mm, level_mm, .. } = &self.correction;
        if !grid.is_valid() || values_mm.len() != grid.len() {
            let [dx, dy] = grid.spacing_mm;
            let found = format!(
                "{} values for a grid of {} x {} nodes, {dx} x {dy} mm apart",
                values_mm.len(),
                grid.columns,
                grid.rows
            );
            return Some(found);
        }
        if !values_mm.iter().all(|v| v.is_finite()) || !level_mm.is_finite() {
            return Some("a number of its correction is not finite".into());
        }
        if self.correction.parameters.as_ref().is_some_and(|set| !set.is_valid(grid.len())) {
            return Some("a parameter of its correction is impossible, or belongs to another grid".into());
        }
        if !self.fields.is_valid() {
            return Some("a hyperparameter of its error fields is impossible".into());
        }
        (!self.known.is_valid()).then(|| "a number of its knowledge of the grinder is impossible".into())
    }

    /// Returns the correction for the first pass of the next part. The learned correction is interpolated to the grid
    /// of `none`. It compensates the error that repeated in every pass of the last part.
    ///
    /// `none` is the correction of 0 for the new part. The result has the grid, the number of the pass and the level
    /// (the height of the target surface above the nominal surface) of `none`.
    pub fn first_correction(&self, none: Correction) -> Correction {
        let on_grid = |values: &Vec<f64>| self.correction.grid.resample(values, &none.grid);
        let set = self.correction.parameters.as_ref().map(|set| ParameterCorrections {
            displacement_mm: on_grid(&set.displacement_mm),
            setting_mm: on_grid(&set.setting_mm),
            apparent_mm: on_grid(&set.apparent_mm),
            since_cycle: none.cycle,
            ..*set
        });
        Correction { values_mm: on_grid(&self.correction.values_mm), parameters: set, ..none }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_core::compensation::{ErrorMap, GainRule, MapOptions, PassObservation};
    use regrind_core::geometry::Grid;
    use regrind_core::model::{Field, Hyperparameters};

    const GRID: Grid = Grid { columns: 5, rows: 4, first_mm: [-2.0, -1.5], spacing_mm: [1.0, 1.0] };

    fn learned() -> Learned {
        let correction = Correction::zero(GRID, 0.05);
        let values = (0..GRID.len()).map(|k| 1e-3 * k as f64).collect();
        let error = ErrorMap::exact(GRID, values, vec![true; GRID.len()]);
        let begin = LearningState::new(GainRule::Wavelength, &MapOptions::new(1.0, 1.0), [4.0, 3.0], None);
        let known =
            begin.updated(&PassObservation { correction: &correction, error: &error, response: None, explained: None });
        Learned::new(true, "a part".into(), "run-1".into(), correction.compensating(&known, None), known)
    }

    fn setting(id: &str) -> SettingIdentity {
        SettingIdentity { id: id.into(), earlier: format!("{id} of an earlier version") }
    }

    fn read(text: &str) -> Result<Option<(Learned, Vec<u8>)>, LearnedError> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("learned.json"), text).unwrap();
        Learned::read(folder.path(), &setting("a part"), true)
    }

    #[test]
    fn learned_read_round_trip() {
        let text = serde_json::to_string(&learned()).unwrap();
        let (back, bytes) = read(&text).unwrap().unwrap();
        assert_eq!(back.correction, learned().correction);
        assert_eq!(bytes, text.as_bytes());
        assert_eq!(serde_json::to_string(&back).unwrap(), text);
        assert!(
            Learned::read(tempfile::tempdir().unwrap().path(), &setting(""), true).unwrap().is_none(),
            "no file is nothing learned"
        );
        // Another grid of the same part: values between the nodes are interpolated, and the level is that of the new
        // part.
        let finer = Grid { columns: 9, rows: 7, spacing_mm: [0.5, 0.5], ..GRID };
        let first = back.first_correction(Correction::zero(finer, 0.06));
        assert_eq!((first.level_mm, first.cycle, first.values_mm.len()), (0.06, 1, 63));
        assert_eq!(first.values_mm[2], back.correction.values_mm[1]);
    }

    #[test]
    fn learned_from_others_names_sources() {
        let mut alike = MachineSimilarity::default();
        alike.add_statement(0.1);
        let of = |cell: &str| {
            let from = CellRun { cell: cell.into(), run: format!("run-{cell}") };
            let text = serde_json::to_vec(&learned().with_kind("such parts".into())).unwrap();
            let read =
                |kind: &str, simulation| Learned::read_other(Path::new("there"), &text, &setting(kind), simulation);
            assert!(read("other parts", true).is_err() && read("such parts", false).is_err());
            (from, read("such parts", true).unwrap())
        };
        let others = [of("cell-1"), of("cell-3")];
        let fresh = LearningState::new(GainRule::Wavelength, &MapOptions::new(1.0, 1.0), [4.0, 3.0], None);
        let none = Correction::zero(GRID, 0.05);
        let begun = Learned::from_others(&others, &alike, (true, "mine".into()), (&fresh, none.clone())).unwrap();
        assert_eq!(begun.run, "run-cell-1 of cell-1 and run-cell-3 of cell-3");
        let told = begun.origin.as_ref().unwrap();
        assert_eq!((told.runs.len(), told.comparisons), (2, 1));
        // The saved copy can be read back, and is not mistaken for the result of a run.
        let text = serde_json::to_vec(&begun).unwrap();
        let back = Learned::from_saved(Path::new("kept"), &text).unwrap();
        assert_eq!((&back.correction, &back.origin), (&begun.correction, &begun.origin));
        let kind = serde_json::to_vec(&begun.with_kind("such parts".into())).unwrap();
        assert!(Learned::read_other(Path::new("there"), &kind, &setting("such parts"), true).is_err());
        assert!(Learned::from_others(&[], &alike, (true, "mine".into()), (&fresh, none)).is_none());
    }

    #[test]
    fn learned_fields_round_trip() {
        let mut fields = PartPriors::default();
        fields.update(
            true,
            &Hyperparameters { field: Field::new(1e-3, 15.0), noise_sigma_mm: 3e-4, noise_autocorrelation: 0.0 },
        );
        let text = serde_json::to_string(&learned().with_fields(fields)).unwrap();
        assert_eq!(read(&text).unwrap().unwrap().0.fields, fields);
        // The format that earlier versions wrote.
        let plain = serde_json::to_string(&learned()).unwrap();
        let old = plain.replace(",\"fields\":{}", "");
        assert_ne!(plain, old);
        assert_eq!(serde_json::to_string(&read(&old).unwrap().unwrap().0).unwrap(), plain);
        let error = read(&text.replace("\"range_mm\":[15.0", "\"range_mm\":[-15.0")).unwrap_err().to_string();
        assert!(error.contains("error fields") && error.contains("archive"), "{error}");
    }

    #[test]
    fn learned_ignores_other_settings() {
        let text = serde_json::to_string(&learned()).unwrap();
        for (from, to) in
            [("a part", "another"), ("\"simulation\":true", "\"simulation\":false"), ("\"layout\":2,", "")]
        {
            assert!(text.contains(from));
            assert!(read(&text.replacen(from, to, 1)).unwrap().is_none(), "{to}");
        }
        // Whatever else has become of it.
        assert!(read("{\"setting\": \"another\", \"simulation\": true, \"known\": 7}").unwrap().is_none());
    }

    #[test]
    fn learned_refuses_impossible_values() {
        let text = serde_json::to_string(&learned()).unwrap();
        let broken = |from: &str, to: &str| {
            assert!(text.contains(from), "no {from} in {text}");
            // Where it stands once and where it stands again: the correction and the mean.
            let all = [text.replacen(from, to, 1), text.replace(from, to)];
            all.map(|text| {
                let error = read(&text).unwrap_err().to_string();
                assert!(error.contains("learned.json") && error.contains("archive"), "{error}");
                error
            })
        };
        let [error, _] = broken("\"columns\":5", "\"columns\":6");
        assert!(error.contains("20 values") && error.contains("6 x 4 nodes"), "{error}");
        assert!(broken("\"columns\":5,\"rows\":4", "\"columns\":0,\"rows\":0")[0].contains("0 x 0"));
        assert!(broken("\"spacing_mm\":[1.0,1.0]", "\"spacing_mm\":[0.0,1.0]")[0].contains("0 x 1 mm apart"));
        assert!(broken("\"response\":[1.0", "\"response\":[7.0")[0].contains("impossible"));
        assert!(broken("\"run\"", "\"ran\"")[0].contains("run"));
        // The mean has a grid of its own.
        let at = text.rfind("\"columns\":5").unwrap();
        let of_mean = format!("{}{}", &text[..at], text[at..].replacen("\"columns\":5", "\"columns\":0", 1));
        assert!(read(&of_mean).unwrap_err().to_string().contains("impossible"));
        for text in ["", "{", &text[..text.len() / 2], "[]", "7"] {
            assert!(matches!(read(text), Err(LearnedError::Broken { .. })), "{text}");
        }
    }
}
