//! Events of the machine behind a server of I++ DME, in order. A test compares them with the record of the client.

use crate::Vec3;

/// Event of the machine.
#[derive(Clone, Debug, PartialEq)]
pub enum MachineEvent {
    /// The machine began to move for this command. For a touch, the motion continues from `to_mm` along the normal and
    /// returns.
    MotionStarted {
        /// Name of the command.
        command: String,
        /// Start position of the probe's centre, in the machine's frame.
        from_mm: Vec3,
        /// Target of the motion.
        to_mm: Vec3,
    },
    /// The motion has ended or was interrupted: the machine is at rest.
    MotionEnded {
        /// Position of the probe's centre.
        at_mm: Vec3,
    },
    /// The machine touched the part or the sphere, and reports it.
    Touched {
        /// Commanded point.
        point_mm: Vec3,
        /// Normal of the touch.
        normal: Vec3,
        /// Position of the probe's centre.
        centre_mm: Vec3,
    },
    /// The machine carried out an abort.
    Aborted,
    /// The stop circuit opened.
    Stopped,
    /// The server was restarted, and has forgotten everything before.
    Restarted,
}

/// Observer that receives each event when it happens.
pub type Observer = Box<dyn FnMut(&MachineEvent) + Send>;
