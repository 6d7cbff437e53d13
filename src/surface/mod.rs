//! Nominal surfaces: what the part should be.

pub mod analytic;

pub use analytic::{AnalyticSurface, DefinedSurface, DefinitionError, SampledSurface, Sampling, SurfaceDefinition};
