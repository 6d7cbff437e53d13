//! Tests of the I++ DME driver against servers at the far end of its connection.

mod bench;
mod faults;
mod jobs;
mod other_server;
mod scans;
mod transcript;
mod vectors;
