//! The driver of I++ DME against servers at the far end of its wire.

mod vectors;
