//! Files in and out: points, meshes and maps.

mod headers;
mod map_files;
mod points;
mod real_files;
