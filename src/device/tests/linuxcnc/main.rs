//! A grinder by LinuxCNC: against a server in this process that does what it is told to, and against the controller
//! itself.

mod bench;
mod fake;
mod isolated;
mod on_a_controller;
mod rsh;
