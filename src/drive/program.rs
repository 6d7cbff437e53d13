//! Program of a pass: from the correction to the file that a controller runs.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::compensation::path::{
    ArcSummary, HeightField, MachineLimits, PathError, PathMode, PathOptions, PathSummary, TargetSurface, TiltMode,
    ToolPath, TrackPattern, TrackSpacing, Wheel, axis_offsets, nominal_height_field,
};
use crate::compensation::{Correction, ParameterKind};
use crate::formats::gcode::{
    Dialect, DialectError, Exactness, GcodeError, ProgramHeader, write_axis_table, write_program,
};
use crate::formats::result::read_bytes;
use crate::formats::run_files::{CycleFile, tool_path_file};
use crate::formats::write_atomic;
use crate::geometry::Aperture;
use crate::surface::Nominal;

use super::recorder::OutputFiles;

/// Maximum number of points of a program that a run writes with each correction.
const MAX_PROGRAM_POINTS: u64 = 3_000_000;

/// Common properties of the programs of a part.
#[derive(Debug)]
pub struct Programs {
    /// Name of the part.
    pub part: String,
    /// SHA-256 of the source of the nominal surface.
    pub part_identity: [u8; 32],
    /// Nominal surface as a height over x and y, and outline of the part.
    pub surface_and_outline: (HeightField, Aperture),
    /// Options of the paths.
    pub options: PathOptions,
    /// Limits of the grinder.
    pub limits: MachineLimits,
    /// Exactness with which the controller follows a program.
    pub mode: PathMode,
    /// Maximum rounding of corners with [`PathMode::Blend`], in mm.
    pub path_tolerance_mm: f64,
    /// Rounding by a setting of the controller, if it is known, in mm.
    pub controller_tolerance_mm: Option<f64>,
    /// Maximum distance of arcs from the path, in mm; `None` for lines only.
    pub arcs_within_mm: Option<f64>,
    /// Dialect of the programs.
    pub dialect: Dialect,
    /// Additional folder for the program of each pass, where the controller finds it.
    pub folder: Option<PathBuf>,
    /// Number of passes without in-feed.
    pub spark_out_passes: u16,
    /// True if the cell is simulated.
    pub simulation: bool,
}

/// Reason why there is no program.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ProgramError {
    #[error(transparent)]
    Path(#[from] PathError),
    #[error(transparent)]
    File(#[from] GcodeError),
    #[error(
        "the program of the next pass would have {points} points, limit {MAX_PROGRAM_POINTS}; increase grinding.chord_error_um in the recipe, or write \
         the program with `regrind plan --program`"
    )]
    TooLong { points: u64 },
    #[error(
        "the file {path} differs from the program that Regrind wrote; check the program folder (grinder.program.folder)"
    )]
    CopyDiffers { path: PathBuf },
}

impl Programs {
    /// Returns the nominal surface of a part as a height z over x and y, with the outline of the part. The paths of the
    /// wheel are planned on this surface, within this outline.
    ///
    /// # Errors
    /// The surface cannot be described as a height over x and y.
    pub fn surface_and_outline(nominal: &Nominal) -> Result<(HeightField, Aperture), PathError> {
        nominal_height_field(nominal)
    }

    /// Returns the file name of the program of a pass. Its extension is defined by the dialect (the program language of
    /// the controller).
    pub(super) fn file_name(&self) -> String {
        tool_path_file(&self.dialect.dialect.extension)
    }

    /// Checks that the dialect (the program language of the controller) can express a program with these settings. The
    /// checked settings are the path tolerance, arcs, and the rotary axis if the wheel is tilted.
    ///
    /// # Errors
    /// The dialect cannot express a setting, or the settings require arcs together with a tilted wheel.
    pub fn check_dialect(&self) -> Result<(), DialectError> {
        if let Some(rotary) = self.options.tilting_axis() {
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

    /// Plans the path of the wheel for a pass with the correction `correction`, and checks it against the limits of the
    /// grinder. Returns the path and its summary (extent, length, duration, and peak speeds).
    ///
    /// # Errors
    /// The wheel does not fit the corrected surface, or the path exceeds a limit of the grinder.
    pub fn path(&self, correction: &Correction) -> Result<(ToolPath, PathSummary), PathError> {
        let (nominal, outline) = (self.nominal(correction), &self.surface_and_outline.1);
        let wheel = self.wheel(correction);
        let wanted = TargetSurface::new(nominal, &path_correction(correction), wheel.reach_mm())?;
        let path = ToolPath::new(wanted, outline.clone(), PathOptions { wheel, ..self.options })?;
        let summary = path.summary()?;
        summary.check(&self.limits)?;
        Ok((path, summary))
    }

    /// Returns the number of moves, arcs and lines in the program of `path`, and the largest deviation of an arc from
    /// the path. Returns `None` if the program has lines only.
    ///
    /// # Errors
    /// The dialect cannot express the settings of the program.
    pub fn arc_summary(&self, path: &ToolPath) -> Result<Option<ArcSummary>, DialectError> {
        let post = self.dialect.post(&self.exactness())?;
        Ok(post.arcs.map(|(_, options)| path.arc_summary(&options)))
    }

    /// Returns the wheel for a pass: the wheel of the recipe, with a radius that is larger by the estimated radius
    /// error in `correction`.
    fn wheel(&self, correction: &Correction) -> Wheel {
        self.options.wheel.with_larger_radius(self.wheel_radius_error_mm(correction))
    }

    /// Returns the nominal surface relative to the zero of the machine, lowered by dR, the estimated error of the wheel
    /// radius in `correction`.
    ///
    /// The zero is set by touching off with the lowest point of the wheel, while the recipe's radius is assumed. The
    /// centre of a wheel that is larger by dR is then higher by dR than assumed. Lowering the surface by dR compensates
    /// this difference.
    fn nominal(&self, correction: &Correction) -> HeightField {
        self.surface_and_outline.0.clone().lowered(self.wheel_radius_error_mm(correction))
    }

    /// Returns the estimated wheel radius minus the radius in the recipe, in mm; 0 if it is not estimated.
    fn wheel_radius_error_mm(&self, correction: &Correction) -> f64 {
        correction.parameters.as_ref().map_or(0.0, |set| set.value(ParameterKind::WheelRadius))
    }

    /// Plans the path of a pass and writes its program to `file`. Returns the summary of the path. `map_identity` is
    /// the SHA-256 of the correction map, which the header of the program states.
    ///
    /// # Errors
    /// Those of [`Programs::path`], and a file that cannot be written.
    pub fn write(
        &self,
        file: &Path,
        correction: &Correction,
        map_identity: [u8; 32],
    ) -> Result<PathSummary, ProgramError> {
        let (path, summary) = self.path(correction)?;
        self.write_program(file, correction, map_identity, &path, &summary)?;
        Ok(summary)
    }

    /// Writes the program of a pass, and the table `toolpath_z.csv` with the offsets of axis Z, into `files`. Copies
    /// the program to the program folder of the controller, if the cell file names one. `map_identity` is the SHA-256
    /// of the correction map.
    ///
    /// Returns `None` if program and table were written. Returns the reason if one of them was omitted: the program is
    /// too long (then the table is omitted too), or the table cannot be computed.
    ///
    /// # Errors
    /// No path can be planned, a file cannot be written, the copy differs, or the program is too long and the cell file
    /// names a program folder.
    pub(super) fn save(
        &self,
        files: &mut OutputFiles,
        correction: &Correction,
        map_identity: [u8; 32],
    ) -> Result<Option<String>, ProgramError> {
        let (path, summary) = self.path(correction)?;
        if summary.points > MAX_PROGRAM_POINTS {
            let error = ProgramError::TooLong { points: summary.points };
            if self.folder.is_some() {
                return Err(error);
            }
            return Ok(Some(format!("{} was not written: {error}", self.file_name())));
        }
        let file = files.add_named(&self.file_name());
        self.write_program(&file, correction, map_identity, &path, &summary)?;
        self.copy_to_controller(&file, correction.cycle)?;
        match self.save_table(&files.add_file(CycleFile::AxisTable), correction, map_identity, &path) {
            Ok(()) => Ok(None),
            Err(ProgramError::Path(error)) => {
                Ok(Some(format!("{} was not written: {error}", CycleFile::AxisTable.name())))
            }
            Err(error) => Err(error),
        }
    }

    /// Copies `program` to the program folder of the controller, and reads the copy back. The dialect forms the name of
    /// the copy from the name of the part and the number of the cycle. Does nothing if the cell file names no program
    /// folder.
    ///
    /// # Errors
    /// A file cannot be read or written, or the copy differs from the program.
    fn copy_to_controller(&self, program: &Path, cycle: u16) -> Result<(), ProgramError> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let bytes = read_bytes(program).map_err(GcodeError::from)?;
        let extension = &self.dialect.dialect.extension;
        let path = folder.join(self.dialect.name(&self.part, cycle)).with_extension(extension);
        write_atomic(&path, &bytes).map_err(GcodeError::from)?;
        match read_bytes(&path).is_ok_and(|there| there == bytes) {
            true => Ok(()),
            false => Err(ProgramError::CopyDiffers { path }),
        }
    }

    /// Writes the correction of a pass as a table to `file`, for controllers that compensate their axes by a table. The
    /// table contains the offset of axis Z in mm at each node of the correction's grid over x and y. `path` is the
    /// planned path with this correction. `map_identity` is the SHA-256 of the correction map, which the table states.
    ///
    /// # Errors
    /// The wheel is tilted, the offsets cannot be computed, or the file cannot be written.
    fn save_table(
        &self,
        file: &Path,
        correction: &Correction,
        map_identity: [u8; 32],
        path: &ToolPath,
    ) -> Result<(), ProgramError> {
        if self.options.tilt.is_some() {
            return Err(PathError::TableOfTilted.into());
        }
        let none = Correction { values_mm: vec![0.0; correction.grid.len()], ..correction.clone() };
        let before = TargetSurface::new(self.nominal(correction), &none, 1.0)?;
        let mut offsets = axis_offsets(&before, path.target(), &path.options().wheel, &correction.grid)?;
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
        summary: &PathSummary,
    ) -> Result<(), ProgramError> {
        let header = ProgramHeader {
            part: self.part.clone(),
            cycle: correction.cycle,
            base_identity: self.part_identity,
            map_identity,
            uncorrected: correction.is_zero(),
            level_mm: correction.level_mm,
            wheel: if self.options.from_below { self.wheel(correction).mirrored() } else { self.wheel(correction) }
                .description(),
            from_below: self.options.from_below,
            rotary: self.options.tilting_axis().copied(),
            lean: describe_tilt(self.options.tilt),
            parameters: describe_parameter_corrections(correction, self.options.wheel.reach_mm()),
            tracks: describe_tracks(path),
            spark_out_passes: self.spark_out_passes,
            simulation: self.simulation,
            exactness: self.exactness(),
        };
        Ok(write_program(file, &header, &self.dialect, summary, path)?)
    }
}

/// Returns the correction whose map is used to plan the path of the wheel.
///
/// Without corrections of machine parameters, the result is `correction` itself. With such corrections, a displacement
/// is added to each value of the map. This displacement compensates the wrong position of the wheel and the tilt of the
/// part. The error of the wheel radius is not added, because [`Programs::path`] plans the path with the corrected
/// radius.
fn path_correction(correction: &Correction) -> Cow<'_, Correction> {
    match &correction.parameters {
        None => Cow::Borrowed(correction),
        Some(_) => Cow::Owned(Correction { values_mm: correction.map_mm().into_owned(), ..correction.clone() }),
    }
}

/// Returns a line of text for each machine parameter that `correction` compensates. The line states the error, the pass
/// since which it is compensated, and whether the map or the wheel radius compensates it. `wheel_radius_mm` is the
/// radius in the recipe. Returns an empty list if no parameter is compensated.
pub(super) fn describe_parameter_corrections(correction: &Correction, wheel_radius_mm: f64) -> Vec<String> {
    let Some(set) = &correction.parameters else { return Vec::new() };
    let taken = ParameterKind::ALL.into_iter().zip(set.values).filter(|(_, value)| *value != 0.0);
    let line = |(kind, value): (ParameterKind, f64)| {
        let said = format!("{}: off by {:.3} {}", kind.name(), kind.display_units_per_unit() * value, kind.unit());
        let since = set.since_cycle;
        match kind {
            ParameterKind::WheelRadius => {
                let true_mm = wheel_radius_mm + value;
                format!(
                    "{said}, {true_mm:.6} mm instead of {wheel_radius_mm} mm; since pass {since} the true wheel radius compensates this error, not the map"
                )
            }
            _ => format!("{said}; compensated since pass {since} by the map"),
        }
    };
    taken.map(line).collect()
}

fn describe_tilt(lean: Option<TiltMode>) -> String {
    match lean {
        None => String::new(),
        Some(TiltMode::Constant { angle_rad }) => format!("constant by {:.4} degrees", angle_rad.to_degrees()),
        Some(TiltMode::Following { lead_rad }) => format!("{:.4} degrees from the normal", lead_rad.to_degrees()),
    }
}

fn describe_tracks(path: &ToolPath) -> String {
    let options = path.options();
    let pattern = match (options.pattern, options.one_way) {
        (TrackPattern::Raster, true) => "raster along +x",
        (TrackPattern::Raster, false) => "raster along x, to and fro",
        (TrackPattern::Spiral, _) => "spiral inwards",
    };
    let scallop = match options.spacing {
        TrackSpacing::Scallop { max_height_mm: height_mm, .. } => {
            format!(", ridges of {:.3} um at most", 1e3 * height_mm)
        }
        TrackSpacing::Distance(_) => String::new(),
    };
    format!(
        "{} track pieces, {:.6} mm apart, {pattern}{scallop}, chord error at most {:.4} um, overrun {} mm",
        path.track_count(),
        path.track_mm(),
        1e3 * options.chord_error_mm,
        options.overrun_mm
    )
}
