//! Files in and out: points, meshes and maps.

#[path = "../../../../tests/common/data.rs"]
mod data;
mod headers;
mod map_files;
mod points;
mod real_files;
