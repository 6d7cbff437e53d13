//! Whole runs: the program and its drive against simulated machines on real wires, in normal and in faulty conditions.
//!
//! Signals, modes and the socket of a run are specific to Unix. The tests for Windows are in .ci/windows.
#![cfg(unix)]

mod again;
mod apart;
mod audit;
mod bad_cells;
mod careful;
#[path = "../common/payloads.rs"]
mod client_payloads;
mod contents;
mod convergence;
mod cycles;
#[path = "../common/data.rs"]
mod data;
mod defects;
mod dialects;
mod earlier_records;
mod faults;
mod files;
mod first_touches;
mod gone;
mod heartbeats;
mod height_maps;
mod hit_lines;
mod ippdme;
#[path = "../common/keep.rs"]
mod keep;
mod killed;
mod learning;
mod linuxcnc;
mod local_users;
mod lying;
mod manual;
mod mirror_cell;
mod mirror_run;
mod namespaces;
mod orders;
#[path = "../common/outlived.rs"]
mod outlived;
mod outside;
mod panics;
mod parameters;
#[path = "../common/perfect.rs"]
mod perfect;
mod prepared;
mod production;
#[path = "../common/program.rs"]
mod program;
mod replay;
mod reports;
mod results;
#[path = "../common/rig.rs"]
mod rig;
#[path = "../common/sample.rs"]
mod sample;
mod shared;
mod so_far;
mod study;
#[path = "../common/through.rs"]
mod through;
mod touches;
#[path = "../common/tries.rs"]
mod tries;
mod truth;
mod watching;
#[path = "../common/wire_faults.rs"]
mod wire_faults;
mod worlds;
