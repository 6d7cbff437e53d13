//! Files in and out: point clouds, meshes, and what a registration leaves behind.
