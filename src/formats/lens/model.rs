//! Lens of a design program: its surfaces, of which one is the nominal surface.

use regrind_core::geometry::Aperture;
use regrind_core::surface::SurfaceChoice;
use regrind_core::surface::analytic::{AnalyticSurface, DefinedSurface, DefinitionError, Sampling};

use super::super::choice_error::{ChoiceError, check_is_no_name, number_of};

/// Surface of a lens.
///
/// Frame: the origin is at the vertex, z runs along the light. Units: millimetres.
#[derive(Clone, Debug, PartialEq)]
pub struct LensSurface {
    /// Its number in the file.
    pub number: usize,
    /// Comment or label; empty if it has none.
    pub name: String,
    /// Type as the file has it.
    pub kind: String,
    /// Whether the surface is not a plane.
    pub is_curved: bool,
    /// Outline in the file.
    pub aperture: Option<Aperture>,
    /// Disc outside of which the file does not define the surface; `None` if it has no such limit.
    pub disc: Option<TermsDisc>,
    /// The surface, or the reason why it cannot be taken.
    pub surface: Result<AnalyticSurface, String>,
}

/// Number of points of an outline that are held against the disc.
const OUTLINE_POINTS: usize = 720;

/// Part of the normalisation radius by which rounding may move an outline beyond it.
const ROUNDING: f64 = 1e-9;

/// Disc on which the Zernike terms of a surface are defined.
///
/// Frame: that of the surface. Units: millimetres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TermsDisc {
    /// Its middle.
    pub centre_mm: [f64; 2],
    /// Its radius, the normalisation radius of the terms.
    pub radius_mm: f64,
}

impl TermsDisc {
    /// Returns the distance in mm from the middle to the farthest point of `aperture`.
    fn reach_mm(&self, aperture: &Aperture) -> f64 {
        let distance = |[x, y]: &[f64; 2]| (x - self.centre_mm[0]).hypot(y - self.centre_mm[1]);
        match aperture {
            Aperture::Circle { centre_mm, radius_mm: radius }
            | Aperture::Annulus { centre_mm, outer_radius_mm: radius, .. } => distance(centre_mm) + radius,
            _ => aperture.outline_mm(OUTLINE_POINTS).iter().map(distance).fold(0.0, f64::max),
        }
    }
}

/// Surfaces of a lens, in the order of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct LensModel {
    /// The surfaces.
    pub surfaces: Vec<LensSurface>,
}

impl LensModel {
    /// Returns the surface that is chosen. Without a choice it is the only curved one.
    ///
    /// # Errors
    /// Returns an error if there is no such surface, if several fit, or if the surface cannot be taken.
    pub fn choose(&self, choice: Option<&SurfaceChoice>) -> Result<&LensSurface, ChoiceError> {
        let found = match choice {
            Some(SurfaceChoice::Number(number) | SurfaceChoice::NumberOrName(number)) => {
                if matches!(choice, Some(SurfaceChoice::NumberOrName(_))) {
                    let surfaces = self.surfaces.iter().map(|surface| (surface.number, &surface.name[..]));
                    check_is_no_name(*number, surfaces)?;
                }
                let numbers = || self.surfaces.iter().map(|surface| surface.number).collect();
                let found = self.surfaces.iter().find(|surface| surface.number == *number);
                found.ok_or_else(|| ChoiceError::NoSurface { number: *number, numbers: numbers() })?
            }
            Some(SurfaceChoice::Name(name)) => {
                let names: Vec<&str> = self.surfaces.iter().map(|surface| &surface.name[..]).collect();
                &self.surfaces[number_of(name, &names)? - 1]
            }
            None | Some(SurfaceChoice::Largest) => {
                let curved: Vec<&LensSurface> = self.surfaces.iter().filter(|surface| surface.is_curved).collect();
                match curved[..] {
                    [one] => one,
                    [] => return Err(ChoiceError::NoCurvedSurface),
                    _ => {
                        let numbers = curved.iter().map(|surface| surface.number).collect();
                        return Err(ChoiceError::SeveralSurfaces { numbers });
                    }
                }
            }
        };
        match &found.surface {
            Ok(_) => Ok(found),
            Err(reason) => {
                let (number, kind, reason) = (found.number, found.kind.clone(), reason.clone());
                Err(ChoiceError::Unreadable { number, kind, reason })
            }
        }
    }
}

impl LensSurface {
    /// Returns the surface with its outline. `aperture` replaces the outline of the file.
    ///
    /// # Errors
    /// Returns an error if the surface cannot be taken, if there is no outline, or if the surface is not defined within
    /// it, such as where the outline reaches beyond the disc of the Zernike terms.
    pub fn defined(&self, aperture: Option<Aperture>, sampling: Sampling) -> Result<DefinedSurface, ChoiceError> {
        let unreadable =
            |reason: String| ChoiceError::Unreadable { number: self.number, kind: self.kind.clone(), reason };
        let surface = self.surface.clone().map_err(&unreadable)?;
        let aperture = aperture.or_else(|| self.aperture.clone());
        let aperture = aperture.ok_or(ChoiceError::NoOutline { number: self.number })?;
        aperture.validate().map_err(DefinitionError::Aperture)?;
        if let Some(disc) = &self.disc {
            let (reach_mm, radius_mm) = (disc.reach_mm(&aperture), disc.radius_mm);
            if reach_mm > radius_mm * (1.0 + ROUNDING) {
                return Err(unreadable(format!(
                    "its outline reaches {reach_mm} mm from the centre of its Zernike terms, beyond their normalisation \
                     radius of {radius_mm} mm, where the file does not define them; give a smaller aperture"
                )));
            }
        }
        Ok(DefinedSurface::new(surface, aperture, sampling)?)
    }
}
