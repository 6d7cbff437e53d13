//! `regrind accuracy`: estimates the error of distances to a nominal surface, and the point spacing for a required
//! accuracy.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;
use regrind::formats::NominalFile;
use regrind::setup;
use regrind::surface::accuracy::{
    Accuracy, ErrorEstimate, ErrorFigures, NominalPoints, Reliability, estimate_accuracy,
};
use regrind::surface::{Nominal, PlaneProjection};
use serde::Serialize;

use super::choice::word_of;
use super::face_list::{FaceLine, face_lines, lens_lines, listed};
use super::failure::Failure;
use super::nominal::{self, NominalTable};
use super::words::{counted, three_digits};
use super::{Outcome, finite_above_zero};

/// Estimate from a nominal surface alone the error of distances to it, and the spacing for a required accuracy
#[derive(Args, Debug)]
#[command(after_help = "\
The command builds two coarser surfaces, each from a part of the points. The command then measures the distances of the
other points from each coarser surface. All points lie on the nominal surface, so these distances are errors. The error
of the whole surface is extrapolated from the errors of the two coarser surfaces.

Example:
  regrind accuracy --nominal lens.csv --want 1

Exit codes: 0 the error PV in the line `curved` is at most --want, or --want is not given; 1 this error exceeds --want;
2 bad arguments or data; 3 fault.")]
pub(super) struct Arguments {
    /// Nominal surface: points as text or PLY, a mesh as STL or PLY, a CAD model as STEP or IGES, or a TOML definition
    #[arg(long, value_name = "FILE")]
    nominal: PathBuf,
    #[command(flatten)]
    table: NominalTable,
    /// Projection of scattered points for the triangulation
    #[arg(long, value_parser = word_of::<PlaneProjection>(), default_value = "auto")]
    projection: PlaneProjection,
    /// Maximum error of the distance, peak to valley, in nm
    #[arg(long, value_name = "NM", allow_negative_numbers = true, value_parser = finite_above_zero)]
    want: Option<f64>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Document {
    /// Faces of a CAD model, in the order of the file.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    faces: Vec<FaceLine>,
    points: usize,
    spacing_mm: f64,
    wanted_pv_nm: Option<f64>,
    curved: Kind,
    triangle: Kind,
}

#[derive(Serialize)]
struct Kind {
    pv_nm: f64,
    rms_nm: f64,
    max_nm: f64,
    border_pv_nm: f64,
    border_rms_nm: f64,
    border_max_nm: f64,
    worst_at_mm: [f64; 3],
    worst_error_nm: f64,
    worst_near_border: bool,
    order: f64,
    observed_order: f64,
    trust: &'static str,
    /// Point spacing in mm for the error that `--want` allows. `None` without `--want`, or if no spacing reaches that
    /// error.
    wanted_spacing_mm: Option<f64>,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let (found, faces) = judge(arguments)?;
    let document = Document {
        faces,
        points: found.points,
        spacing_mm: found.spacing_mm,
        wanted_pv_nm: arguments.want,
        curved: Kind::new(&found.curved, arguments.want),
        triangle: Kind::new(&found.flat, arguments.want),
    };
    if [&document.curved, &document.triangle].iter().any(|kind| !kind.is_finite()) {
        return Err(Failure::NotFinite { what: "an error" });
    }
    if arguments.json {
        super::print_json(&document)?;
    } else {
        super::print(&summary(&document, arguments))?;
    }
    let reached = arguments.want.is_none_or(|want| document.curved.pv_nm <= want);
    Ok(if reached { Outcome::Accepted } else { Outcome::NotInTolerance })
}

/// Returns the estimate, and the faces of a CAD model.
fn judge(arguments: &Arguments) -> Result<(Accuracy, Vec<FaceLine>), Failure> {
    let (path, projection) = (&arguments.nominal, arguments.projection);
    let file = nominal::read(path, projection, &arguments.table.table())?;
    let selection = arguments.table.selection();
    let faces = match &file {
        NominalFile::Faces(model) => face_lines(model, &selection),
        NominalFile::Lens(lens) => lens_lines(lens, &selection),
        _ => Vec::new(),
    };
    let defined = setup::defined_from_file(path, &file, &selection);
    // The faces are what a person needs to choose another one.
    if defined.is_err() && !arguments.json {
        super::print(&listed(&faces))?;
    }
    let estimate = if let Some(surface) = defined.map_err(Failure::Setup)? {
        let grid = nominal::sampled(path, &surface)?;
        let (columns, rows) = (grid.columns, grid.rows);
        estimate_accuracy(NominalPoints::Grid { columns, rows, points: &grid.points, normals: &grid.normals })
    } else {
        match file {
            NominalFile::Points(points) => estimate_accuracy(NominalPoints::Points { points: &points, projection }),
            NominalFile::Mesh { points, triangles } => {
                // Every command reports a bad mesh with the same message.
                Nominal::from_mesh(points.clone(), triangles)
                    .and_then(|mesh| mesh.check_is_open())
                    .and_then(|()| estimate_accuracy(NominalPoints::Points { points: &points, projection }))
            }
            NominalFile::Definition(_) | NominalFile::Faces(_) | NominalFile::Lens(_) => {
                unreachable!("they define a surface")
            }
        }
    };
    let estimate = estimate.map_err(|source| Failure::Nominal { path: path.clone(), source })?;
    Ok((estimate, faces))
}

impl Kind {
    fn new(estimate: &ErrorEstimate, wanted_nm: Option<f64>) -> Self {
        let nm = |ErrorFigures { pv_mm, rms_mm, max_mm }| [pv_mm, rms_mm, max_mm].map(|mm| 1e6 * mm);
        let [pv_nm, rms_nm, max_nm] = nm(estimate.inside);
        let [border_pv_nm, border_rms_nm, border_max_nm] = nm(estimate.border);
        Self {
            pv_nm,
            rms_nm,
            max_nm,
            border_pv_nm,
            border_rms_nm,
            border_max_nm,
            worst_at_mm: estimate.max_error.point.into(),
            worst_error_nm: 1e6 * estimate.max_error.error_mm,
            worst_near_border: estimate.max_error.near_border,
            order: estimate.order,
            observed_order: estimate.observed_order,
            trust: match estimate.reliability {
                Reliability::Extrapolated => "extrapolated",
                Reliability::Rounding => "rounding",
                Reliability::TooCoarse => "too-coarse",
            },
            wanted_spacing_mm: wanted_nm.and_then(|nm| estimate.spacing_for(1e-6 * nm)).filter(|h| h.is_finite()),
        }
    }

    fn is_finite(&self) -> bool {
        let sum = self.pv_nm + self.rms_nm + self.max_nm + self.worst_error_nm + self.order + self.observed_order;
        (sum + self.border_pv_nm + self.border_rms_nm + self.border_max_nm).is_finite()
    }
}

fn summary(document: &Document, arguments: &Arguments) -> String {
    let mut text = listed(&document.faces);
    writeln!(
        text,
        "nominal     {}: {}, spacing {} mm",
        arguments.nominal.display(),
        counted(document.points, "point"),
        three_digits(document.spacing_mm)
    )
    .expect("text grows");
    for (name, kind) in [("curved", &document.curved), ("triangle", &document.triangle)] {
        describe(&mut text, name, kind, arguments.want).expect("text grows");
    }
    text
}

fn describe(text: &mut String, name: &str, kind: &Kind, want: Option<f64>) -> std::fmt::Result {
    let d = three_digits;
    writeln!(
        text,
        "{name:<12}error PV {} nm, rms {} nm, largest {} nm; near the border PV {} nm",
        d(kind.pv_nm),
        d(kind.rms_nm),
        d(kind.max_nm),
        d(kind.border_pv_nm)
    )?;
    let [x, y, z] = kind.worst_at_mm;
    let place = if kind.worst_near_border { "near the border" } else { "inside" };
    writeln!(text, "{:<12}worst {} nm at ({x:.3}, {y:.3}, {z:.3}) mm, {place}", "", d(kind.worst_error_nm))?;
    match kind.trust {
        "rounding" => writeln!(
            text,
            "{:<12}the error hardly falls with the spacing: the points are rounded or scatter by as much; write more decimals",
            ""
        )?,
        "too-coarse" => writeln!(
            text,
            "{:<12}too coarse to extrapolate: the surface has features of the size of a few spacings; give a finer nominal",
            ""
        )?,
        _ => {}
    }
    match (want, kind.wanted_spacing_mm) {
        (Some(want), Some(spacing)) => {
            writeln!(text, "{:<12}a spacing of {} mm gives PV {} nm", "", d(spacing), d(want))
        }
        (Some(want), None) => writeln!(text, "{:<12}no spacing of such points gives PV {} nm", "", d(want)),
        (None, _) => Ok(()),
    }
}
