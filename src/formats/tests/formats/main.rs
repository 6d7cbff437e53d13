//! Files in and out: points, meshes and maps.

mod cad;
mod headers;
mod iges_text;
mod instrument_maps;
mod lens;
mod map_files;
mod measured_documents;
mod points;
mod real_files;
mod step_text;
