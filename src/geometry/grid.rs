//! Regular grids among unordered points.
