//! Tests of the commands as a person types them, and of the files that a person writes.

// The book uses a Unix shell.
#[cfg(unix)]
mod book;
mod commands;
#[path = "../common/keep.rs"]
mod keep;
#[path = "../common/program.rs"]
mod program;
mod recipe;
