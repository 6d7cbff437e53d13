//! CAD model: faces, of which one is the nominal surface.

use rayon::prelude::*;
use regrind_core::geometry::Pose;
use regrind_core::surface::SurfaceChoice;
use regrind_core::surface::parametric::Face;

use super::super::choice_error::{ChoiceError, check_is_no_name, number_of};
use super::super::error::FormatError;

/// Share by which the largest face must exceed the next one. The areas are sums over small patches, with an error of
/// about 1 %.
const MIN_AREA_STEP: f64 = 0.02;

/// Share of the largest rough area below which a face cannot be the largest.
const MIN_ROUGH_SHARE: f64 = 0.7;

/// Face of a CAD model as the file has it.
#[derive(Clone, Debug, PartialEq)]
pub struct CadFace {
    /// Its name in the file; empty if it has none.
    pub name: String,
    /// Kind of its surface in words.
    pub kind: String,
    /// The face, or the reason why it cannot be read.
    pub face: Result<Face, String>,
}

/// Faces of a CAD file, in the order of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct CadModel {
    /// The faces; the first has the number 1.
    pub faces: Vec<CadFace>,
}

impl CadFace {
    pub(super) fn new(name: String, kind: String, face: Result<Face, FormatError>) -> Self {
        // The path stands before the message of the file anyhow.
        let face = face.map_err(|error| match error {
            FormatError::Unexpected { place, expected, found, .. } => {
                format!("{place}: expected {expected}, found `{found}`")
            }
            error => error.to_string(),
        });
        Self { name, kind, face }
    }

    pub(super) fn moved(&self, motion: &Pose) -> Self {
        Self { face: self.face.as_ref().map(|face| face.moved(motion)).map_err(Clone::clone), ..self.clone() }
    }
}

impl CadModel {
    pub(super) fn new(faces: Vec<CadFace>) -> Self {
        Self { faces }
    }

    /// Returns the number, counted from 1, and the face that is chosen. Without a choice it is the largest, if it is
    /// clear which one that is.
    ///
    /// # Errors
    /// Returns an error if there is no such face, if several have the name, if the face cannot be read, or if no face
    /// is clearly the largest.
    pub fn choose(&self, choice: Option<&SurfaceChoice>) -> Result<(usize, &Face), ChoiceError> {
        let names: Vec<&str> = self.faces.iter().map(|face| &face.name[..]).collect();
        let number = match choice {
            Some(SurfaceChoice::Number(number)) => *number,
            Some(SurfaceChoice::NumberOrName(number)) => {
                check_is_no_name(*number, (1..).zip(names))?;
                *number
            }
            Some(SurfaceChoice::Name(name)) => number_of(name, &names)?,
            Some(SurfaceChoice::Largest) => self.largest()?,
            None => self.only_possible()?,
        };
        let face = number.checked_sub(1).and_then(|at| self.faces.get(at));
        let face = face.ok_or(ChoiceError::NoNumber { number, count: self.faces.len() })?;
        let unreadable =
            |reason: &String| ChoiceError::Unreadable { number, kind: face.kind.clone(), reason: reason.clone() };
        face.face.as_ref().map(|face| (number, face)).map_err(unreadable)
    }

    /// Returns the number of the largest face, if no face could be larger: each can be read.
    fn only_possible(&self) -> Result<usize, ChoiceError> {
        let unreadable =
            (1..).zip(&self.faces).find_map(|(number, face)| Some((number, face, face.face.as_ref().err()?)));
        match unreadable {
            None => self.largest(),
            Some((number, face, reason)) if self.faces.len() == 1 => {
                Err(ChoiceError::Unreadable { number, kind: face.kind.clone(), reason: reason.clone() })
            }
            Some((number, face, reason)) => {
                Err(ChoiceError::UnknownArea { number, kind: face.kind.clone(), reason: reason.clone() })
            }
        }
    }

    /// Returns the number of the face with the largest area, among those that can be read.
    fn largest(&self) -> Result<usize, ChoiceError> {
        let faces: Vec<(usize, &Face)> =
            (1..).zip(&self.faces).filter_map(|(number, face)| Some((number, face.face.as_ref().ok()?))).collect();
        let rough: Vec<f64> = faces.par_iter().map(|(_, face)| face.rough_area_mm2()).collect();
        let largest = rough.iter().copied().filter(|area| area.is_finite()).fold(0.0, f64::max);
        // A thin face can lie between the few places of a rough area.
        let can_be_largest = |area: f64| area == 0.0 || area.is_nan() || area >= MIN_ROUGH_SHARE * largest;
        let candidates = faces.into_iter().zip(rough).filter(|(_, area)| can_be_largest(*area));
        let areas = candidates.map(|((number, face), _)| (number, face.area_mm2()));
        let areas: Vec<(usize, f64)> = areas.filter(|(_, area)| area.is_finite() && *area > 0.0).collect();
        let largest = areas.iter().fold(0.0f64, |largest, (_, area)| largest.max(*area));
        let alike = areas.iter().filter(|(_, area)| *area >= largest * (1.0 - MIN_AREA_STEP));
        match alike.map(|(number, _)| *number).collect::<Vec<_>>()[..] {
            [number] => Ok(number),
            [] => Err(ChoiceError::NoArea),
            ref numbers => Err(ChoiceError::SeveralLargest { numbers: numbers.to_vec() }),
        }
    }
}
