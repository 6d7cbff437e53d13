//! The commands as a person types them, and the files that a person writes.

mod commands;
mod recipe;
