//! Errors of a stitching.

use thiserror::Error;

use crate::registration::RegistrationError;
use crate::surface::SurfaceError;

/// Reason why maps cannot be stitched. Maps count from 1 in the messages, from 0 in the fields.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum StitchingError {
    #[error("there are {maps} maps; at least 2 are required")]
    TooFewMaps { maps: usize },
    #[error("map {} has {points} points; at least {min_points} are required", map + 1)]
    TooFewPoints { map: usize, points: usize, min_points: usize },
    #[error("the standard uncertainty of the start poses is {sigma_mm} mm; it must be above 0 and finite")]
    PlacementSigma { sigma_mm: f64 },
    #[error("points can be stitched as probe centres or as contact points only; choose the method offset or contact")]
    Method,
    #[error(
        "map {} has {places} places in common with the maps that are joined to map 1; at least {min_places} are \
         required; check its start pose, or measure with more overlap", map + 1
    )]
    NoOverlap { map: usize, places: usize, min_places: usize },
    #[error(
        "map {}: only {on_part} of {points} points lie on the part and are no outliers; check its start pose, and that it \
         is of this part", map + 1
    )]
    OffPart { map: usize, on_part: usize, points: usize },
    #[error(
        "the poses of the maps still change after {rounds} steps; check the start poses, and that all maps are of one \
         part"
    )]
    NotConverged { rounds: usize },
    #[error("the maps together: {0}")]
    Whole(#[from] RegistrationError),
    #[error(transparent)]
    Surface(#[from] SurfaceError),
}
