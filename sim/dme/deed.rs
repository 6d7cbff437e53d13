//! What the machine behind a server of I++ DME did, in order, for a test to hold against what its client has on record.

use crate::Vec3;

/// One thing that the machine did.
#[derive(Clone, Debug, PartialEq)]
pub enum Deed {
    /// It began to move, by a command of this name; a touch goes on from there along the normal, and comes back.
    Moves {
        /// The command.
        command: String,
        /// Where the probe's centre was, in the machine's frame.
        from_mm: Vec3,
        /// Where it goes.
        to_mm: Vec3,
    },
    /// What it was at is over, or was broken off: it stands.
    Stands {
        /// Where the probe's centre is.
        at_mm: Vec3,
    },
    /// It touched the part, or the sphere, and says so.
    Touched {
        /// Where it was sent.
        point_mm: Vec3,
        /// Along which normal.
        normal: Vec3,
        /// Where the probe's centre was.
        centre_mm: Vec3,
    },
    /// It was told to abort, and did.
    Aborted,
    /// Its stop circuit opened.
    Stopped,
    /// Its server was started anew, and knows nothing of what was.
    Restarted,
}

/// Who is told of everything as it happens.
pub type Witness = Box<dyn FnMut(&Deed) + Send>;
