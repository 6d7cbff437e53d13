//! A disk beneath SQLite that fails, fills up, stalls and loses power when a test says so.
//!
//! [`Disk::under`] lays one under a folder. From then on SQLite, in the whole process, reaches its files through this
//! crate: those of a folder with a disk obey the [`Fault`]s that were asked for, all others go to the system as before.
//! So what is tested is opened, written and read as always, and tests of one process do not meet.
//!
//! The disk carries out what SQLite does with its files: the database, its write-ahead log, its rollback journal, and
//! the locks and the shared index beside them. Files that a program writes by itself do not pass through it.
//!
//! [`Disk::remembering`] also keeps what a real disk would still hold: the bytes of each file at its last sync, what
//! was written since, and which names the folder is sure of. Before each change it lays a [`Cut`] by: the moment at
//! which the power may go. From a cut folders are made as a computer might find them afterwards. What was written and
//! not brought to the disk is lost, is there, or is torn at sectors of 512 bytes, each by itself and in any order.
//!
//! SQLite waits for nothing here: a sleep of its own is over at once, and a sync is done when the memory of the disk
//! has it.
//!
//! It stands in for a disk of Unix; elsewhere there are the drawn numbers alone.

#[cfg(unix)]
mod image;
#[cfg(unix)]
mod plan;
mod seeded_numbers;
#[cfg(unix)]
mod vfs;

#[cfg(unix)]
pub use image::{Cut, Outcome};
#[cfg(unix)]
pub use plan::{Disk, Fault, Operation, Stall};
pub use seeded_numbers::SeededNumbers;
