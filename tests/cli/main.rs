//! The commands as a person types them, and the files that a person writes.

mod book;
mod commands;
#[path = "../common/keep.rs"]
mod keep;
#[path = "../common/program.rs"]
mod program;
mod recipe;
