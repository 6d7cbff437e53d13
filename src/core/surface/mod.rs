//! Nominal surfaces: the intended form of the part, as points with normals, and the offset surface at a probe's radius
//! from it.
//!
//! ```text
//!  points --+-- regular grid? ----------------> grid lattice   (no triangulation; normals from the grid lines)
//!           +-- projection -> Delaunay -------> mesh lattice   (flat arrays; normals fitted where touched)
//!  mesh ----------------------------------------^
//!  formula -> sampled, exact normals -> grid lattice
//!                                                    \
//!                                                     OffsetSurface: foot, distance, normal of any point
//! ```
//!
//! Pure: no file, no clock, no randomness. Frame: all coordinates are in the model frame {M}. Units: millimetres.

pub mod accuracy;
pub mod analytic;
mod delaunay;
mod triangulation;
mod error;
mod facet;
mod curvature_feature;
mod fold;
mod project_x4;
mod grid_topology;
mod mesh_topology;
mod nominal;
mod normals;
mod offset;
mod patch;
mod prefetch;
mod plane_projection;
mod nominal_noise;
pub(crate) mod simd;

pub use analytic::{AnalyticSurface, DefinedSurface, DefinitionError, SampledSurface, Sampling, SurfaceDefinition};
pub use error::SurfaceError;
pub use facet::Side;
pub(crate) use facet::points_x4;
pub(crate) use curvature_feature::{CurvatureFeature, fit_features};
pub(crate) use project_x4::ProjectionX4;
pub use nominal::{Nominal, NominalKind};
pub(crate) use offset::Lookup;
pub use offset::{DistanceModel, PointProjection, OffsetSurface, FacetIndex};
pub use plane_projection::PlaneProjection;
pub(crate) use plane_projection::{is_line, principal_axes};
