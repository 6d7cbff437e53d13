//! `regrind register`: finds the pose of the part and its deviations from the nominal surface.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::figures::Interval;
use regrind::formats::run_files::CycleFile;
use regrind::formats::{
    Alternative, NominalInput, NotedPoints, RegistrationDocument, ResultFolder, read_measured_with_notes, save_form,
    save_registration,
};
use regrind::geometry::Pose;
use regrind::model::{AngleInterval, Form, IsoFigures, ModelInputs, SlopeFigures};
use regrind::registration::register;
use regrind::surface::Nominal;

use super::Outcome;
use super::failure::Failure;
use super::fit_arguments::{FitArguments, MeasuredTable};
use super::nominal::{self, NominalTable, kind_in_words};
use super::words::{count, counted, three_digits};

/// Register measured probe centres to the offset of a nominal surface
#[derive(Args, Debug)]
#[command(after_long_help = LONG_HELP, after_help = "Example:\n  regrind register --nominal lens.csv --measured cmm.csv \
--probe-radius 1.5 --out registered\n\n--help shows more than -h.")]
pub(super) struct Arguments {
    /// Nominal surface: points as text or PLY, a mesh as STL or PLY, a CAD model as STEP or IGES, or a TOML definition
    #[arg(long, value_name = "FILE")]
    nominal: PathBuf,
    /// Measured points as text or PLY, in mm, or as QIF or DMIS output, or an interferometer's or profilometer's map (X3P, SDF, MetroPro, datx, sur, opd, opdx, al3d and others)
    #[arg(long, value_name = "FILE")]
    measured: PathBuf,
    #[command(flatten)]
    table: MeasuredTable,
    #[command(flatten)]
    of_nominal: NominalTable,
    /// Folder for the results; created if absent
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    fit: FitArguments,
    /// Separate the form from the noise of the probe, with the uncertainties of both: model.json and form.csv
    #[arg(long)]
    model: bool,
    /// Print registration.json instead of a summary
    #[arg(long)]
    json: bool,
}

const LONG_HELP: &str = "\
Example:
  regrind register --nominal lens.csv --measured cmm.csv --probe-radius 1.5 --out registered

Writes into the folder:
  registration.json           the pose cmm_from_model (4 rows of 4, mm), and its uncertainty
  deviations.csv              a row per measured point in the order given: contact point and normal in the
                              model frame, deviation (positive for excess material), used (1 or 0)
  deviation_uncertainty.csv   standard uncertainty of each deviation in mm, in the same order
with --model also
  model.json                  PV and RMS of the form without the noise of the probe, with 95 % intervals; the
                              uncertainty of the position of the nominal frame for an unknown form
  form.csv                    the form at each used point, and its standard uncertainty, in mm

`covariance` is 6 x 6 in the order [translation; rotation] of the twist, in mm and rad: the small motion in the
model frame from the true pose to the estimated pose. Locked and undetermined directions have no variance.
`objective_mm2` is the sum of squared deviations after each accepted step; `trace` has every step with its number
of points. `outliers` and `off_part` are indices of measured points, from 0.

Exit codes: 0 registered; 2 bad arguments or data; 3 fault.";

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let options = arguments.fit.options()?;
    let folder = ResultFolder::prepare(&arguments.out)?;
    let ((nominal, choice), measured) = read_inputs(arguments)?;
    let mut registration = register(&nominal, &measured.points, &options)
        .map_err(|e| Failure::of_registration(e, &arguments.nominal, &arguments.measured))?;
    registration.quality.warnings.extend(measured.notes.iter().map(ToString::to_string));
    let nominal_file =
        NominalInput { file: &arguments.nominal, points: nominal.len(), kind: kind_in_words(nominal.kind(), choice) };
    let document = RegistrationDocument::new(&registration, &options, nominal_file, &arguments.measured);
    document.check().map_err(|what| Failure::NotFinite { what })?;
    save_registration(folder.path(), &document, &registration.deviations).map_err(Failure::NotSaved)?;
    let form = if arguments.model {
        Some(Form::estimate(&registration, &ModelInputs::default()).map_err(Failure::NoModel)?)
    } else {
        None
    };
    if let Some(form) = &form {
        save_form(folder.path(), form, &registration, None).map_err(Failure::NotSaved)?;
    }
    if arguments.json {
        super::print_json(&document)?;
    } else {
        super::print(&summary(&document, folder.path()))?;
        super::print(&form.as_ref().map_or(String::new(), form_in_words))?;
    }
    folder.keep();
    Ok(Outcome::Accepted)
}

/// Reads the nominal file and the measured file that `arguments` name, in parallel. Returns the nominal surface with
/// the words that say which of several it is, and the measured points. The points contain notes about doubtful lines, for
/// example a last line without a line end.
///
/// Returns an error if a file is invalid. Also returns an error if the measured file is a height map (X3P, SDF or
/// MetroPro) and the method of the registration is not `Contact`.
fn read_inputs(arguments: &Arguments) -> Result<((Nominal, Option<String>), NotedPoints), Failure> {
    let (path, projection) = (&arguments.nominal, arguments.fit.projection);
    arguments.fit.check_is_fit_for(&arguments.measured)?;
    let of_measured = arguments.table.table();
    std::thread::scope(|scope| {
        let nominal = scope.spawn(|| nominal::surface(path, projection, &arguments.of_nominal));
        let measured = read_measured_with_notes(&arguments.measured, &of_measured);
        let nominal = nominal.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        Ok((nominal, measured?))
    })
}

/// Returns the result of the registration as lines of text for an operator: the files, the numbers of points, the
/// deviation in µm, the pose, the warnings and the alternative poses.
/// `folder` is the folder with the result files.
fn summary(document: &RegistrationDocument, folder: &Path) -> String {
    let um = |mm: f64| three_digits(1e3 * mm);
    let mut text = String::new();
    let mut line = |name: &str, words: String| {
        writeln!(text, "{name:<12}{words}").expect("text grows");
    };
    line(
        "nominal",
        format!(
            "{}: {}, {}",
            document.nominal.file.display(),
            counted(document.nominal.points, "point"),
            document.nominal.kind
        ),
    );
    line(
        "measured",
        format!(
            "{}: {}, {} used, {}, {} off the part",
            document.measured.file.display(),
            counted(document.points, "point"),
            count(document.used),
            counted(document.outliers.len(), "outlier"),
            count(document.off_part.len()),
        ),
    );
    line("deviation", format!("RMS {} µm, PV {} µm", um(document.rms_mm), um(document.pv_mm)));
    line("pose", pose_in_words(document));
    line("iterations", format!("{}, converged", document.iterations));
    line("coverage", format!("{:.0} % of the nominal surface", 100.0 * document.coverage));
    for weak in document.weak_directions {
        line("weak", weak.description.clone());
    }
    for warning in document.warnings {
        line("warning", warning.clone());
    }
    for other in &document.alternatives {
        line(
            "",
            format!(
                "another pose also fits: {} away from the pose above, RMS {} µm for a sample of the points",
                apart(document, other),
                um(other.rms_mm)
            ),
        );
    }
    let files = [CycleFile::Registration, CycleFile::Deviations, CycleFile::DeviationUncertainty].map(CycleFile::name);
    line("files", format!("{} in {}", files.join(", "), folder.display()));
    text
}

/// Returns the estimated form error as lines of text for a person. The lines state RMS, PV and PV 99.8 % of the form in
/// µm with 95 % intervals, the parameters of the Gaussian-process model, and the standard uncertainty of the position
/// of the nominal frame in µm. They contain a warning if there are too few points to separate the form from the noise.
fn form_in_words(form: &Form) -> String {
    let um = |mm: f64| three_digits(1e3 * mm);
    let within =
        |figure: &Interval| format!("{} µm ({} to {})", um(figure.median_mm), um(figure.low_mm), um(figure.high_mm));
    let Form { hyperparameters, figures, frame_covariance, .. } = form;
    let drift = match hyperparameters.noise_autocorrelation {
        0.0 => String::new(),
        drift => format!("; correlation with the noise of the next point along the path {} %", (100.0 * drift).round()),
    };
    let lay = hyperparameters.field.anisotropy.angle_rad().map_or(String::new(), |angle_rad| {
        let (times, degrees) = (three_digits(hyperparameters.field.anisotropy.stretch), angle_rad.to_degrees().round());
        format!(", where the range in the direction {degrees}° from x is {times} times the range across this direction")
    });
    let sigma = [0, 1, 2].map(|k| um(frame_covariance[(k, k)].sqrt())).join(", ");
    let areas = area_in_words(form);
    let few = match form.is_underdetermined {
        true => format!(
            "warning     {} degrees of freedom are too few to separate the form from the noise; at least 20 are required. The upper limits therefore \
             count the whole deviation as form. They also include form that the fit of the pose can have removed from the deviations. Measure more points\n",
            form.degrees_of_freedom
        ),
        false => String::new(),
    };
    format!(
        "form        RMS {}, PV {}, PV 99.8 % {}; 95 % intervals\n{few}{areas}model       form with standard deviation {} µm and range {} mm{lay}; noise of a point {} µm{drift}\n\
         frame       standard uncertainty of the position {sigma} µm along x, y, z, because the form is unknown\n",
        within(&figures.rms),
        within(&figures.pv),
        within(&figures.pv_998),
        um(hyperparameters.field.sigma_mm),
        three_digits(hyperparameters.field.range_mm),
        um(hyperparameters.noise_sigma_mm),
    )
}

/// Returns lines of text for a person: the slopes of the form in µrad, and the figures of ISO 10110-5 (power,
/// irregularity, symmetric part) in nm, each with a 95 % interval. Omits the slopes or the figures if they could not be
/// computed, for example from too few points. The text is empty if both are missing.
fn area_in_words(form: &Form) -> String {
    let mut text = String::new();
    if let Some(SlopeFigures { rms, max: largest, integration_mm, .. }) = form.slope {
        let urad = |of: AngleInterval| {
            let [median, low, high] = [of.median_rad, of.low_rad, of.high_rad].map(|rad| three_digits(1e6 * rad));
            format!("{median} urad ({low} to {high})")
        };
        let length = three_digits(integration_mm);
        text += &format!(
            "slopes      RMS {}, largest {}; integration length {length} mm; 95 % intervals\n",
            urad(rms),
            urad(largest)
        );
    }
    if let Some(IsoFigures { power, irregularity, symmetric, .. }) = form.iso {
        let [power, irregularity, symmetric] = [power, irregularity, symmetric].map(|of| {
            let [median, low, high] = [of.median_mm, of.low_mm, of.high_mm].map(|mm| three_digits(1e6 * mm));
            format!("{median} nm ({low} to {high})")
        });
        text +=
            &format!("ISO 10110-5 power {power}, irregularity {irregularity}, symmetric {symmetric}; 95 % intervals\n");
    }
    text
}

fn pose_in_words(document: &RegistrationDocument) -> String {
    let pose = Pose::from_rows(document.cmm_from_model).expect("a pose that was found is one");
    let [x, y, z] = pose.translation_mm.into();
    format!("shift {x:.4}, {y:.4}, {z:.4} mm, turned by {:.4} degrees", pose.angle_rad().to_degrees())
}

/// Returns the distance between the pose found and an alternative pose, as text: translation in mm and rotation in
/// degrees.
fn apart(document: &RegistrationDocument, other: &Alternative) -> String {
    let read = |rows| Pose::from_rows(rows).expect("a pose that was found is one");
    let between = read(document.cmm_from_model).inverse() * read(other.cmm_from_model);
    let (shift, turn) = (between.translation_mm.norm(), between.angle_rad().to_degrees());
    format!("{} mm and {} degrees", three_digits(shift), three_digits(turn))
}
