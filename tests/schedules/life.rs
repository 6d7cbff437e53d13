//! One life of the program. It counts the program's effects on the world, and can end between any two of them.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use tokio::sync::Notify;

/// Life of the program, from its start to its end or to its death.
#[derive(Debug)]
pub struct Life {
    effects: AtomicU64,
    dies_at: u64,
    dead: AtomicBool,
    died: Notify,
}

impl Life {
    /// Returns a life that ends before the effect of this number, counted from 1; `u64::MAX` is never.
    pub fn new(dies_at: u64) -> Self {
        Self { effects: AtomicU64::new(0), dies_at, dead: AtomicBool::new(false), died: Notify::new() }
    }

    /// Counts an effect. Returns true if it takes place: a dead program has none.
    pub fn passes(&self) -> bool {
        if !self.is_dead() && self.effects.fetch_add(1, Ordering::Relaxed) + 1 >= self.dies_at {
            self.dead.store(true, Ordering::Relaxed);
            self.died.notify_one();
        }
        !self.is_dead()
    }

    pub fn is_dead(&self) -> bool {
        self.dead.load(Ordering::Relaxed)
    }

    pub fn effects(&self) -> u64 {
        self.effects.load(Ordering::Relaxed)
    }

    /// Waits for death.
    pub async fn died(&self) {
        while !self.is_dead() {
            self.died.notified().await;
        }
    }

    /// Ends the life for everything that still belongs to it.
    pub fn end(&self) {
        self.dead.store(true, Ordering::Relaxed);
    }
}
