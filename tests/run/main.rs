//! Whole runs: the program and its drive against simulated machines on real wires, in normal and in faulty conditions.
//!
//! Signals, modes and the socket of a run are specific to Unix. The tests for Windows are in .ci/windows.
#![cfg(unix)]

regrind_testcell::program!();

mod again;
mod apart;
mod audit;
mod bad_cells;
mod careful;
mod contents;
mod convergence;
mod cycles;
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
mod outside;
mod panics;
mod parameters;
mod prepared;
mod production;
mod replay;
mod reports;
mod results;
mod shared;
mod so_far;
mod touches;
mod truth;
mod watching;
mod worlds;
