//! Events of a controller, in order. A test compares them with the record of the client.

/// Event of a controller.
#[derive(Clone, Debug, PartialEq)]
pub enum ControllerEvent {
    /// The controller has opened a program.
    Opened {
        /// Path of the program.
        path: String,
    },
    /// The controller has begun to run a program.
    Began {
        /// Path of the program.
        path: String,
        /// Text of the program.
        text: String,
    },
    /// The machine moves.
    MotionStarted,
    /// The machine is at rest.
    MotionEnded,
    /// The program has ended.
    Ended {
        /// Path of the program.
        path: String,
    },
    /// A client has aborted the program.
    Aborted,
    /// The stop circuit opened, or the drives went off.
    Stopped,
    /// The controller ended, and restarted without any state.
    Killed,
}

/// Observer that receives each event when it happens.
pub type Observer = Box<dyn FnMut(&ControllerEvent) + Send>;
