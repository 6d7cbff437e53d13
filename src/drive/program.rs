//! The program of a pass: from the correction to the file that a controller runs.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::compensation::path::{
    ArcSummary, Field, Lean, Limits, PathError, PathMode, PathOptions, Pattern, Summary, ToolPath, TrackSpacing,
    Wanted, Wheel, axis_offsets, height_of,
};
use crate::compensation::{Correction, ParameterKind};
use crate::formats::gcode::{
    Dialect, DialectError, Exactness, GcodeError, ProgramHeader, write_axis_table, write_program,
};
use crate::formats::result::read_bytes;
use crate::formats::write_atomic;
use crate::geometry::Aperture;
use crate::surface::Nominal;

use super::record::Files;

/// What a pass leaves beside its correction: the program, with the extension of its dialect, and the table for controllers that compensate
/// by one.
pub(super) const PROGRAM_FILE: &str = "toolpath";
const TABLE_FILE: &str = "toolpath_z.csv";
/// More points than that are not written beside every correction of a run.
const MOST_POINTS: u64 = 3_000_000;

/// What the programs of a part have in common.
#[derive(Debug)]
pub struct Programs {
    /// The part by name.
    pub part: String,
    /// SHA-256 of what the nominal surface came from.
    pub part_identity: [u8; 32],
    /// The nominal surface as a height over x and y, and the outline of the part.
    pub ground: (Field, Aperture),
    /// How paths are laid.
    pub options: PathOptions,
    /// What the grinder can do.
    pub limits: Limits,
    /// How exactly its controller keeps to a program.
    pub mode: PathMode,
    /// How far it may round corners off with [`PathMode::Blend`], in millimetres.
    pub path_tolerance_mm: f64,
    /// How far it does by a setting of its own, where that is known, in millimetres.
    pub controller_tolerance_mm: Option<f64>,
    /// How far arcs may be from the path, in millimetres; none for lines alone.
    pub arcs_within_mm: Option<f64>,
    /// How its programs are written.
    pub dialect: Dialect,
    /// Where else the program of each pass is put, for the controller to find it.
    pub folder: Option<PathBuf>,
    /// Passes without in-feed.
    pub spark_out_passes: u16,
    /// Whether the cell is simulated.
    pub simulation: bool,
}

/// Why there is no program.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ProgramError {
    #[error(transparent)]
    Path(#[from] PathError),
    #[error(transparent)]
    File(#[from] GcodeError),
    #[error(
        "the program of the next pass would have {points} points, more than the {MOST_POINTS} that a run keeps; allow a larger chord error, or \
         write it by `regrind plan --program`"
    )]
    TooLong { points: u64 },
    #[error(
        "{path} does not hold what was written into it; look after the folder of programs (grinder.program.folder)"
    )]
    NotThere { path: PathBuf },
}

impl Programs {
    /// Returns the nominal surface of a part as programs need it.
    ///
    /// # Errors
    /// A surface that is no height over x and y.
    pub fn ground(nominal: &Nominal) -> Result<(Field, Aperture), PathError> {
        height_of(nominal)
    }

    /// Returns what the program of a pass is called in the folder of a cycle.
    pub(super) fn file_name(&self) -> String {
        format!("{PROGRAM_FILE}.{}", self.dialect.dialect.extension)
    }

    /// Tells whether the dialect can say how exactly a program is to be followed.
    ///
    /// # Errors
    /// What it cannot say.
    pub fn check_dialect(&self) -> Result<(), DialectError> {
        if let Some(rotary) = self.options.leaning() {
            self.dialect.turning(rotary)?;
            if self.arcs_within_mm.is_some() {
                return Err(DialectError::ArcsTilted);
            }
        }
        self.dialect.post(&self.exactness()).map(drop)
    }

    fn exactness(&self) -> Exactness {
        Exactness {
            mode: self.mode,
            tolerance_mm: self.path_tolerance_mm,
            controller_mm: self.controller_tolerance_mm,
            chord_error_mm: self.options.chord_error_mm,
            arcs_within_mm: self.arcs_within_mm,
        }
    }

    /// Lays the path of a pass and checks it against what the grinder can do.
    ///
    /// # Errors
    /// A wheel that does not fit the corrected surface, and limits of the grinder that the path goes beyond.
    pub fn path(&self, correction: &Correction) -> Result<(ToolPath, Summary), PathError> {
        let (nominal, outline) = (self.nominal(correction), &self.ground.1);
        let wheel = self.wheel(correction);
        let wanted = Wanted::new(nominal, &handed(correction), wheel.reach_mm())?;
        let path = ToolPath::new(wanted, outline.clone(), PathOptions { wheel, ..self.options })?;
        let summary = path.summary()?;
        summary.check(&self.limits)?;
        Ok((path, summary))
    }

    /// Tells what becomes of a path in arcs; none where its program has lines alone.
    ///
    /// # Errors
    /// What the dialect cannot say.
    pub fn arcs(&self, path: &ToolPath) -> Result<Option<ArcSummary>, DialectError> {
        let post = self.dialect.post(&self.exactness())?;
        Ok(post.arcs.map(|(_, options)| path.arc_summary(&options)))
    }

    /// The wheel as measurements have made it out.
    fn wheel(&self, correction: &Correction) -> Wheel {
        self.options.wheel.larger_by(self.off_mm(correction))
    }

    /// The nominal surface as the zero of the machine has it. It was touched off with the lowest place of the wheel, by the radius of the recipe: the
    /// centre of a wheel that is larger by dR stands higher by that already.
    fn nominal(&self, correction: &Correction) -> Field {
        self.ground.0.clone().lowered(self.off_mm(correction))
    }

    /// By how much the wheel is larger than the recipe has it.
    fn off_mm(&self, correction: &Correction) -> f64 {
        correction.set.as_ref().map_or(0.0, |set| set.value(ParameterKind::WheelRadius))
    }

    /// Writes the program of a pass.
    ///
    /// # Errors
    /// Those of [`Programs::path`], and a file that cannot be written.
    pub fn write(&self, file: &Path, correction: &Correction, map_identity: [u8; 32]) -> Result<Summary, ProgramError> {
        let (path, summary) = self.path(correction)?;
        self.write_program(file, correction, map_identity, &path, &summary)?;
        Ok(summary)
    }

    /// Writes the program and `toolpath_z.csv` of a pass into a folder; returns why not both: a program that is too long to be kept,
    /// a table that reaches where the wheel cannot. Where the controller looks for programs, this one is put too.
    pub(super) fn keep(
        &self,
        files: &mut Files,
        correction: &Correction,
        map_identity: [u8; 32],
    ) -> Result<Option<String>, ProgramError> {
        let (path, summary) = self.path(correction)?;
        if summary.points > MOST_POINTS {
            let error = ProgramError::TooLong { points: summary.points };
            if self.folder.is_some() {
                return Err(error);
            }
            return Ok(Some(format!("there is no {}: {error}", self.file_name())));
        }
        let file = files.place(&self.file_name());
        self.write_program(&file, correction, map_identity, &path, &summary)?;
        self.hand_over(&file, correction.cycle)?;
        match self.keep_table(&files.place(TABLE_FILE), correction, map_identity, &path) {
            Ok(()) => Ok(None),
            Err(ProgramError::Path(error)) => Ok(Some(format!("there is no {TABLE_FILE}: {error}"))),
            Err(error) => Err(error),
        }
    }

    /// Puts a program where the controller looks for it, under its own name, and reads it back.
    fn hand_over(&self, program: &Path, cycle: u16) -> Result<(), ProgramError> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let bytes = read_bytes(program).map_err(GcodeError::from)?;
        let extension = &self.dialect.dialect.extension;
        let path = folder.join(self.dialect.name(&self.part, cycle)).with_extension(extension);
        write_atomic(&path, &bytes).map_err(GcodeError::from)?;
        match read_bytes(&path).is_ok_and(|there| there == bytes) {
            true => Ok(()),
            false => Err(ProgramError::NotThere { path }),
        }
    }

    /// Writes the correction as an offset of Z over the axes, for controllers that compensate by a table.
    fn keep_table(
        &self,
        file: &Path,
        correction: &Correction,
        map_identity: [u8; 32],
        path: &ToolPath,
    ) -> Result<(), ProgramError> {
        if self.options.lean.is_some() {
            return Err(PathError::TableOfTilted.into());
        }
        let none = Correction { values_mm: vec![0.0; correction.grid.len()], ..correction.clone() };
        let before = Wanted::new(self.nominal(correction), &none, 1.0)?;
        let mut offsets = axis_offsets(&before, path.wanted(), &path.options().wheel, &correction.grid)?;
        if self.options.from_below {
            offsets.iter_mut().for_each(|offset| *offset = -*offset);
        }
        write_axis_table(file, &correction.grid, &offsets, &map_identity, self.simulation).map_err(GcodeError::from)?;
        Ok(())
    }

    fn write_program(
        &self,
        file: &Path,
        correction: &Correction,
        map_identity: [u8; 32],
        path: &ToolPath,
        summary: &Summary,
    ) -> Result<(), ProgramError> {
        let header = ProgramHeader {
            part: self.part.clone(),
            cycle: correction.cycle,
            base_identity: self.part_identity,
            map_identity,
            uncorrected: correction.is_none(),
            level_mm: correction.level_mm,
            wheel: if self.options.from_below { self.wheel(correction).mirrored() } else { self.wheel(correction) }
                .description(),
            from_below: self.options.from_below,
            rotary: self.options.leaning().copied(),
            lean: lean_in_words(self.options.lean),
            parameters: set_in_words(correction, self.options.wheel.reach_mm()),
            tracks: tracks_in_words(path),
            spark_out_passes: self.spark_out_passes,
            simulation: self.simulation,
            exactness: self.exactness(),
        };
        Ok(write_program(file, &header, &self.dialect, summary, path)?)
    }
}

/// The correction as a path takes it: what is left for the map, and with it what setting and tilt take back.
fn handed(correction: &Correction) -> Cow<'_, Correction> {
    match &correction.set {
        None => Cow::Borrowed(correction),
        Some(_) => Cow::Owned(Correction { values_mm: correction.map_mm().into_owned(), ..correction.clone() }),
    }
}

/// Says which parameters a correction takes back, a line each; nothing where it takes none.
pub(super) fn set_in_words(correction: &Correction, wheel_radius_mm: f64) -> Vec<String> {
    let Some(set) = &correction.set else { return Vec::new() };
    let taken = ParameterKind::ALL.into_iter().zip(set.values).filter(|(_, value)| *value != 0.0);
    let line = |(kind, value): (ParameterKind, f64)| {
        let said = format!("{}: off by {:.3} {}", kind.name(), kind.units() * value, kind.unit());
        let since = set.since_cycle;
        match kind {
            ParameterKind::WheelRadius => {
                let true_mm = wheel_radius_mm + value;
                format!(
                    "{said}, {true_mm:.6} mm in place of {wheel_radius_mm} mm, since pass {since}; it is not in the map"
                )
            }
            _ => format!("{said}, since pass {since}; what takes it back is in the map that is ground with"),
        }
    };
    taken.map(line).collect()
}

fn lean_in_words(lean: Option<Lean>) -> String {
    match lean {
        None => String::new(),
        Some(Lean::Constant { angle_rad }) => format!("constant by {:.4} degrees", angle_rad.to_degrees()),
        Some(Lean::Following { lead_rad }) => format!("{:.4} degrees from the normal", lead_rad.to_degrees()),
    }
}

fn tracks_in_words(path: &ToolPath) -> String {
    let options = path.options();
    let pattern = match (options.pattern, options.one_way) {
        (Pattern::Raster, true) => "raster along +x",
        (Pattern::Raster, false) => "raster along x, to and fro",
        (Pattern::Spiral, _) => "spiral inwards",
    };
    let scallop = match options.spacing {
        TrackSpacing::Scallop { height_mm, .. } => format!(", ridges of {:.3} um at most", 1e3 * height_mm),
        TrackSpacing::Distance(_) => String::new(),
    };
    format!(
        "{} pieces, {:.6} mm apart, {pattern}{scallop}, chords within {:.4} um, overrun {} mm",
        path.tracks(),
        path.track_mm(),
        1e3 * options.chord_error_mm,
        options.overrun_mm
    )
}
