//! Tests of the commands as a person types them, and of the files that a person writes.

regrind_testcell::program!();

// The book uses a Unix shell.
#[cfg(unix)]
mod book;
mod commands;
#[cfg(unix)]
mod completions;
mod designs;
mod first_day;
mod recipe;
#[cfg(feature = "pdf")]
mod report_pdf;
