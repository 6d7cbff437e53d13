//! The journal: what was acknowledged is there, every change is found, and whoever has no key can sign nothing.

mod closed;
mod other_verifier;
mod seals;
mod tampering;
mod writing;
mod written;
