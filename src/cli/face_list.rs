//! List of the faces of a CAD model, from which a person chooses one.

use std::fmt::Write as _;

use regrind::formats::{CadFace, CadModel, LensModel, LensSurface};
use regrind::geometry::Aperture;
use regrind::surface::SurfaceSelection;
use regrind::surface::parametric::Face;
use serde::Serialize;

/// Face of a CAD model in the list.
#[derive(Serialize)]
pub(super) struct FaceLine {
    number: usize,
    name: String,
    kind: String,
    /// `None` if the face cannot be read.
    area_mm2: Option<f64>,
    /// Size of the box along the axes of the file.
    size_mm: Option<[f64; 3]>,
    /// Outward normal on average, or the normal of the surface if the file does not say which side is outside.
    normal: Option<[f64; 3]>,
    /// Why the face cannot be read.
    reason: Option<String>,
    chosen: bool,
}

/// Returns the faces of a model in the order of the file.
pub(super) fn face_lines(model: &CadModel, selection: &SurfaceSelection) -> Vec<FaceLine> {
    let chosen = model.choose(selection.choice.as_ref()).ok().map(|(number, _)| number);
    let line = |(number, face): (usize, &CadFace)| {
        let read = face.face.as_ref().ok();
        let size = |face: &Face| {
            let [low, high] = face.bounds();
            let size: [f64; 3] = (high - low).into();
            size.iter().all(|length| length.is_finite()).then_some(size)
        };
        FaceLine {
            number,
            name: face.name.clone(),
            kind: face.kind.clone(),
            area_mm2: read.map(Face::area_mm2),
            size_mm: read.and_then(size),
            normal: read.and_then(Face::mean_normal).map(Into::into),
            reason: face.face.as_ref().err().cloned(),
            chosen: chosen == Some(number),
        }
    };
    (1..).zip(&model.faces).map(line).collect()
}

/// Returns the surfaces of a lens in the order of the file.
pub(super) fn lens_lines(lens: &LensModel, selection: &SurfaceSelection) -> Vec<FaceLine> {
    let chosen = lens.choose(selection.choice.as_ref()).ok().map(|surface| surface.number);
    let line = |surface: &LensSurface| {
        let bounds = surface.aperture.as_ref().map(Aperture::bounds);
        FaceLine {
            number: surface.number,
            name: surface.name.clone(),
            kind: if surface.is_curved { surface.kind.clone() } else { format!("{}, a plane", surface.kind) },
            area_mm2: bounds.map(|_| 0.0),
            size_mm: bounds.map(|[low, high]| [high[0] - low[0], high[1] - low[1], 0.0]),
            normal: None,
            reason: surface.surface.as_ref().err().cloned(),
            chosen: chosen == Some(surface.number),
        }
    };
    lens.surfaces.iter().map(line).collect()
}

/// Returns the list of the faces as text, the largest first; `*` marks the chosen one.
pub(super) fn listed(faces: &[FaceLine]) -> String {
    const MAX_LINES: usize = 40;
    let mut sorted: Vec<&FaceLine> = faces.iter().collect();
    sorted
        .sort_by(|a, b| b.chosen.cmp(&a.chosen).then(b.area_mm2.unwrap_or(0.0).total_cmp(&a.area_mm2.unwrap_or(0.0))));
    let mut text = String::new();
    for face in sorted.iter().take(MAX_LINES) {
        let mark = if face.chosen { '*' } else { ' ' };
        let name = if face.name.is_empty() { String::new() } else { format!(" `{}`", face.name) };
        let about = match (&face.reason, face.area_mm2, face.size_mm) {
            (Some(reason), ..) => format!("cannot be read: {reason}"),
            (None, Some(0.0), Some([x, y, _])) => format!("{x:.3} x {y:.3} mm"),
            (None, Some(area), Some([x, y, z])) => {
                let way = face.normal.map(|[x, y, z]| format!(", normal ({x:.3}, {y:.3}, {z:.3})")).unwrap_or_default();
                format!("{area:.2} mm^2, {x:.3} x {y:.3} x {z:.3} mm{way}")
            }
            _ => "no outline".to_owned(),
        };
        writeln!(text, "{mark} {}{name}: {}, {about}", face.number, face.kind).expect("text grows");
    }
    if sorted.len() > MAX_LINES {
        writeln!(text, "  and {} smaller ones", sorted.len() - MAX_LINES).expect("text grows");
    }
    text
}
