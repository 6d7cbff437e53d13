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
mod edges;
mod error;
mod facet;
mod feature;
mod fold;
mod four_feet;
mod grid;
mod mesh;
mod nominal;
mod normals;
mod offset;
mod patch;
mod prefetch;
mod projection;
mod roughness;
pub(crate) mod simd;

pub use analytic::{AnalyticSurface, DefinedSurface, DefinitionError, SampledSurface, Sampling, SurfaceDefinition};
pub use error::SurfaceError;
pub use facet::Side;
pub(crate) use facet::side_by_side;
pub(crate) use feature::{Feature, features};
pub(crate) use four_feet::FourFeet;
pub use nominal::{Nominal, NominalKind};
pub(crate) use offset::Lookup;
pub use offset::{Distance, Foot, OffsetSurface, Place};
pub use projection::Projection;
pub(crate) use projection::{is_line, principal_axes};
