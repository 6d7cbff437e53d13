//! Errors of a nominal surface and of its offset.

use thiserror::Error;

/// Reason why a nominal surface or its offset surface cannot be created.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum SurfaceError {
    #[error("the nominal surface has {points} points and needs at least {min_points}; give more nominal points")]
    TooFewPoints { points: usize, min_points: usize },
    #[error("nominal point {} has a coordinate that is not a finite number; remove or correct the point", index + 1)]
    NotFinite { index: usize },
    #[error(
        "nominal point {} at ({:.6}, {:.6}, {:.6}) mm lies {distance_mm:.6} mm from the middle of the other points, \
         too far to belong to the part; remove or correct this point",
        index + 1, at[0], at[1], at[2]
    )]
    FarOff { index: usize, at: [f64; 3], distance_mm: f64 },
    #[error("all {points} nominal points lie on one line; give points that do not lie on one line")]
    Collinear { points: usize },
    #[error(
        "nominal points {} and {} are both at ({:.6}, {:.6}, {:.6}) mm; remove one of them",
        first + 1, second + 1, at[0], at[1], at[2]
    )]
    DuplicatePoints { first: usize, second: usize, at: [f64; 3] },
    #[error(
        "nominal points {} and {} at ({:.6}, {:.6}, {:.6}) mm are near-duplicates, {apart_mm:e} mm apart: the \
         surface between them is rounding error; remove one of them", first + 1, second + 1, at[0], at[1], at[2]
    )]
    NearDuplicates { first: usize, second: usize, at: [f64; 3], apart_mm: f64 },
    #[error(
        "parts of the nominal surface overlap in every projection that was tried: {tried}; divide the surface into \
         patches, or give a mesh"
    )]
    NoProjection { tried: String },
    #[error("the nominal mesh has no triangle; export a file that contains triangles")]
    NoTriangles,
    #[error(
        "a triangle of the nominal mesh names vertex {vertex}, but the mesh has {points} vertices, counted \
         from 0; export the mesh again"
    )]
    VertexOutOfRange { vertex: u32, points: usize },
    #[error(
        "{triangles} triangles of the nominal mesh share one edge at ({:.6}, {:.6}, {:.6}) mm; a surface has at most \
         two; repair the mesh",
        at[0], at[1], at[2]
    )]
    NonManifold { at: [f64; 3], triangles: usize },
    #[error(
        "{count} triangles of the nominal mesh are duplicates, the first at ({:.6}, {:.6}, {:.6}) mm; remove the \
         duplicates",
        at[0], at[1], at[2]
    )]
    DoubledTriangles { count: usize, at: [f64; 3] },
    #[error(
        "the nominal mesh of {triangles} triangles is a closed solid and does not show which of its faces is ground; \
         export only that face"
    )]
    ClosedSolid { triangles: usize },
    #[error(
        "neighbouring triangles of the nominal mesh turn opposite ways at ({:.6}, {:.6}, {:.6}) mm; give them the \
         same orientation",
        at[0], at[1], at[2]
    )]
    Orientation { at: [f64; 3] },
    #[error(
        "the grid has {columns} x {rows} nodes, and {points} points are given; give one point for each node, and at \
         least 3 nodes along each axis"
    )]
    GridSize { columns: usize, rows: usize, points: usize },
    #[error("a patch list is empty; give at least one patch")]
    NoPatches,
    #[error("the probe radius is {radius_mm} mm; it must be a finite number, 0 or above")]
    ProbeRadius { radius_mm: f64 },
    #[error(
        "the offset surface folds at ({:.3}, {:.3}, {:.3}) mm: the nominal surface is concave there with a radius of \
         {concave_radius_mm:.4} mm, and a probe of radius {probe_radius_mm} mm does not fit; use a smaller probe",
        at[0], at[1], at[2]
    )]
    OffsetFolds { at: [f64; 3], concave_radius_mm: f64, probe_radius_mm: f64 },
}
