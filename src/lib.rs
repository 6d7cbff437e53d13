//! Regrind closes the loop of a precision grinding cell: a free-form part is ground, measured, registered to the offset
//! of its nominal surface, corrected and ground again until it is accepted.
//!
//! A pure state machine decides, thin drivers act, a pure numerical core computes, and one journal records every event.
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
//!  pure: figures, geometry, surface, measuring, registration, stitching, compensation, form, cell: no file, no clock, no randomness, no logging
//! ```
//!
//! Each module knows as little as possible: `cell` knows no points, `registration` no machines, `device` no recipes.
//! `sim` is a separate crate at the far end of the wires and knows no type of this crate. Only `cli` prints or exits.
//! Only `journal`, `formats` and `report` write files.
//!
//! Conventions: millimetres, radians, seconds. Frames are the model frame {M} and the CMM frame {W}. The name of a pose
//! states its mapping: `cmm_from_model`. A deviation is positive where there is too much material, along the outward
//! normal, towards the probe.

pub use regrind_cell as cell;
pub use regrind_core::{compensation, form, geometry, measuring, model, registration, stitching, surface};
pub use regrind_device as device;
pub use regrind_document as document;
pub use regrind_figures as figures;
pub use regrind_formats as formats;
pub use regrind_journal as journal;
pub use regrind_record as record;
pub use regrind_report as report;

pub mod config;
pub mod drive;
pub mod recipe;
pub mod setup;

/// Runs the example of the README as a doc test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
