//! The commands as a person types them, and the files that a person writes.

// The shell of the book is that of Unix.
#[cfg(unix)]
mod book;
mod commands;
#[path = "../common/keep.rs"]
mod keep;
#[path = "../common/program.rs"]
mod program;
mod recipe;
