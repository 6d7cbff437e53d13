//! Ground truth of a simulated grinding cell.
//!
//! This crate uses no type of the controller. The truth therefore cannot leak into the controller, and an error in the
//! controller's geometry cannot hide by being repeated here. Surfaces are closed forms with analytic derivatives, or a
//! fit of this crate's own through points. Contact is solved exactly, and all random numbers come from one seed.
//!
//! ```text
//!  shape   nominal shape of the part: height, gradient, curvature in closed form
//!  point_surface   nominal shape through points
//!  aperture   outline of the part
//!  form    form error left by grinding: a smooth random error along the normal
//!  probe   a ball that touches the part, in a frame of its own, with noise and outliers
//!
//!  spec       the truth in one table: all errors of the cell
//!  machine_class   errors of good, shipped and worn machines
//!  truth      state that the two machines share, and the source of every random number
//!  world      the two machines, and queries for tests
//!  part       the part as it really is, and exact contact with it
//!  removal    the surface that a pass leaves at a node, for every grinder; the three below are its sources of motion
//!  grinder    strokes of a pass over a map
//!  followed_surface   the same strokes, over a program that the grinder reads
//!  executed_wheel     the path of the wheel that a controller executes
//!  program    reader of programs, as a control reads them
//!  cmm        the measuring machine: its result of a plan
//!  payload    the bytes of docs/modbus.md
//!
//!  body       interface of the physics of one machine
//!  register_encoding  values in registers
//!  transfer   payloads in and results out, a page at a time
//!  command    commands, answers and states as the wire has them
//!  options    options of a machine, with its register map
//!  handshake  one machine's side of the handshake: states, interlocks, silence
//!  registers  a whole machine: what a Modbus client reads and writes
//!  line_server        what dme and rsh have in common for their wires
//!  dme        a server of I++ DME, commanded touch by touch
//!  rsh        a LinuxCNC controller, commanded program by program
//!  pending_faults     faults of one of these three
//!  hits       a machine that prints a line for each touch, and receives nothing
//!  event_log  events of the machine
//!  wire       Modbus TCP and RTU, servers of lines, lines of hits, pseudo-terminals, the path of an external controller
//!
//!  simulators         the simulator of each protocol, one line each
//!  simulated_cell     what a simulator is told of its machine, and what it serves
//!  modbus             the simulator of Modbus; those of dme, rsh and hits are in their folders
//! ```
//!
//! Units: millimetres and radians throughout. Frames: `shape` and `form` use the model frame; the points that a probe
//! reports are in the frame of the measuring machine.

pub mod aperture;
pub mod body;
pub mod cmm;
pub mod command;
pub mod dme;
pub mod event_log;
pub mod executed_wheel;
mod followed_surface;
pub mod form;
pub mod grinder;
mod handshake;
pub mod head;
pub mod hits;
pub mod line_server;
pub mod machine_class;
mod machine_spec;
mod modbus;
pub mod motion;
pub mod options;
pub mod part;
pub mod payload;
pub mod pending_faults;
pub mod point_surface;
pub mod probe;
pub mod program;
pub mod register_encoding;
pub mod registers;
mod removal;
pub mod rsh;
pub mod shape;
pub mod simulated_cell;
pub mod simulators;
pub mod spec;
pub mod transfer;
pub mod true_form;
pub mod truth;
mod vector;
pub mod wire;
pub mod world;

/// Position or direction in space.
pub type Vec3 = [f64; 3];

/// Random generator of the whole crate: portable across machines and releases.
pub type Rng = rand::rngs::ChaCha8Rng;

/// Creates the random number generator for a seed.
pub fn rng(seed: u64) -> Rng {
    use rand::SeedableRng;
    Rng::seed_from_u64(seed)
}
