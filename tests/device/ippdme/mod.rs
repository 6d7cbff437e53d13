//! The driver of I++ DME against servers at the far end of its wire.

mod bench;
mod faults;
mod jobs;
mod other_server;
mod scans;
mod transcript;
mod vectors;
