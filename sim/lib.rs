//! The truth behind a simulated grinding cell.
//!
//! This crate knows no type of the controller, so that the truth cannot leak into it and no error of the controller's
//! geometry can hide by being made twice. Surfaces are closed forms with their own derivatives, contact is solved exactly,
//! and everything random comes from one seed.
//!
//! ```text
//!  shape   what the part should be: height, gradient, curvature in closed form
//!  form    what grinding left on it: a smooth random error along the normal
//!  probe   a ball that touches the part, in a frame of its own, with noise and outliers
//!
//!  spec       the truth in one table: what is wrong with everything
//!  truth      what the two machines share, and where every random number comes from
//!  world      the two machines, and queries for tests
//!  part       the part as it really is, and exact contact with it
//!  process    the grinder: what a pass leaves, node by node along its path
//!  executed   the grinder once more: what the wheel leaves along a path that a controller outside really executes
//!  program    what a control reads in a program
//!  follow     what a wheel leaves that follows it
//!  cmm        the measuring machine: what it reports of a plan
//!  payload    the bytes of docs/modbus.md
//!
//!  body       what the physics of one machine must be able to do
//!  words      how values lie in registers
//!  transfer   payloads in and results out, a page at a time
//!  command    commands, answers and states as the wire has them
//!  options    how a machine is set up: where its registers are
//!  handshake  one machine's side of the handshake: states, interlocks, silence
//!  registers  a whole machine: what a Modbus client reads and writes
//!  dme        a server of I++ DME, which is told touch by touch what to do
//!  rsh        a controller by LinuxCNC, which is told which program to run
//!  wheel      what a wheel leaves that is led by a program
//!  faults     what is to go wrong at one of these three
//!  hits       a machine that prints a line for each touch, and hears nothing
//!  seen       what the machine saw and did
//!  wire       Modbus TCP and RTU and I++ DME servers, lines of hits, a serial line without hardware, the path of a controller outside, and
//!             everything that goes wrong on them
//! ```
//!
//! Units: millimetres and radians throughout. Frames: `shape` and `form` live in the model frame, the points a probe reports
//! in the frame of the measuring machine.

pub mod body;
pub mod cmm;
pub mod command;
pub mod dme;
pub mod executed;
pub mod faults;
mod follow;
pub mod form;
mod handshake;
pub mod head;
pub mod hits;
pub mod options;
pub mod part;
pub mod payload;
pub mod probe;
pub mod process;
pub mod program;
pub mod registers;
pub mod rsh;
pub mod seen;
pub mod shape;
pub mod spec;
pub mod transfer;
pub mod truth;
pub mod wheel;
pub mod wire;
pub mod words;
pub mod world;

/// A position or a direction in space.
pub type Vec3 = [f64; 3];

/// The generator behind every random number here: portable across machines and releases.
pub type Rng = rand::rngs::ChaCha8Rng;

/// Returns the generator for a seed.
pub fn rng(seed: u64) -> Rng {
    use rand::SeedableRng;
    Rng::seed_from_u64(seed)
}
