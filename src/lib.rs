//! Regrind closes the loop of a precision grinding cell: a free-form part is ground, measured, registered to the offset of
//! its nominal surface, corrected and ground again until it is accepted.
//!
//! A pure machine decides, thin drivers act, a pure numerical core computes, and everything that happened is in one journal.
//!
//! ```text
//!  recipe.toml -> recipe --+                                             +-> formats, report
//!                          +-> setup -> drive -> device ~~wire~~ [ real machine | sim ]
//!  cell.toml   -> config --+            |  ^ \--> measuring, registration -> compensation, form   (pure)
//!                                 Event v  | Command
//!                                      cell            journal   (written before a command is carried out)
//!
//!  terminal, page <== control ==> drive     (orders, and how the cell is: one door for all)
//!
//!  pure: geometry, surface, measuring, registration, compensation, form, cell: no file, no clock, no randomness, no logging
//! ```
//!
//! Each room knows as little as it can: `cell` knows no point, `registration` no machine, `device` no recipe; `sim`, a crate
//! of its own at the far end of the wires, knows no type of this one. Only `cli` prints or exits; only `journal`, `formats` and
//! `report` write files.
//!
//! Conventions: millimetres, radians, seconds. Frames are the model's {M} and the CMM's {W}; a pose is named for what it does,
//! `cmm_from_model`. A deviation is positive where material stands proud, along the outward normal, the probe's side.

pub use regrind_cell as cell;
pub use regrind_core::{compensation, form, geometry, measuring, model, registration, surface};
pub use regrind_device as device;
pub use regrind_document as document;
pub use regrind_formats as formats;
pub use regrind_journal as journal;
pub use regrind_report as report;

pub mod config;
pub mod drive;
pub mod recipe;
pub mod setup;

/// The example of the README is run as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
