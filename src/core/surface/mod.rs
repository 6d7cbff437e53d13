//! Nominal surfaces: the intended form of the part, as points with normals, and the offset surface at a probe's radius
//! from it.
//!
//! ```text
//!  points --+-- regular grid? ----------------> GridTopology   (no triangulation; normals from the grid lines)
//!           +-- projection -> Delaunay -------> MeshTopology   (flat arrays; a normal is fitted when first needed)
//!  mesh ----------------------------------------^
//!  formula, CAD face -> sampled, exact normals -> GridTopology
//!                                                    \
//!                                                     OffsetSurface: projection, distance, normal of any point
//! ```
//!
//! Pure: no file, no clock, no randomness. Frame: all coordinates are in the model frame {M}. Units: millimetres.

pub mod accuracy;
pub mod analytic;
mod curvature_feature;
mod delaunay;
mod error;
mod facet;
mod fold;
mod grid_topology;
mod mesh_topology;
mod nominal;
mod nominal_noise;
mod normals;
mod offset;
pub mod parametric;
mod patch;
mod plane_projection;
mod prefetch;
mod project_x4;
mod selection;
pub(crate) mod simd;
mod triangulation;

pub use analytic::{AnalyticSurface, DefinedSurface, DefinitionError, SampledSurface, Sampling, SurfaceDefinition};
pub(crate) use curvature_feature::{CurvatureFeature, fit_features};
pub use error::SurfaceError;
pub(crate) use facet::points_x4;
pub use facet::{FacetIndex, Side};
pub use nominal::{Nominal, NominalKind};
pub(crate) use offset::Lookup;
pub use offset::{DistanceModel, OffsetSurface, PointProjection};
pub use plane_projection::PlaneProjection;
pub(crate) use plane_projection::{is_line, principal_axes};
pub(crate) use project_x4::ProjectionX4;
pub use selection::{SurfaceChoice, SurfaceSelection};
