//! Network between cells and their plant that a test can cut: a socket that forwards to another one while it is intact.

use std::io::{Read, Write};
use std::net::Shutdown;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

/// State that both ends of a network share.
#[derive(Default)]
struct Lines {
    is_cut: AtomicBool,
    open: Mutex<Vec<UnixStream>>,
}

pub struct Network(Arc<Lines>);

impl Network {
    /// Listens at one socket and forwards to another. It ends with the test.
    pub fn between(here: &Path, there: PathBuf) -> Self {
        let lines = Arc::new(Lines::default());
        let listener = UnixListener::bind(here).unwrap();
        let shared = Arc::clone(&lines);
        std::thread::spawn(move || {
            for near in listener.incoming().map_while(Result::ok) {
                // A connection through a cut network is not accepted.
                let Ok(far) = UnixStream::connect(&there) else { continue };
                shared.join(near, far);
            }
        });
        Self(lines)
    }

    /// Cuts all open connections, in the middle of a message if necessary, and accepts no new ones.
    pub fn cut(&self) {
        self.0.is_cut.store(true, Ordering::SeqCst);
        for line in self.0.open.lock().unwrap().drain(..) {
            // The connection has possibly ended by itself.
            let _ = line.shutdown(Shutdown::Both);
        }
    }

    pub fn mend(&self) {
        self.0.is_cut.store(false, Ordering::SeqCst);
    }
}

impl Lines {
    fn join(&self, near: UnixStream, far: UnixStream) {
        let mut open = self.open.lock().unwrap();
        if self.is_cut.load(Ordering::SeqCst) {
            return;
        }
        let both = [near.try_clone().unwrap(), far.try_clone().unwrap()];
        open.extend([near.try_clone().unwrap(), far.try_clone().unwrap()]);
        let [near_again, far_again] = both;
        std::thread::spawn(move || hand_on(near, far));
        std::thread::spawn(move || hand_on(far_again, near_again));
    }
}

/// Forwards data until either end closes.
fn hand_on(mut from: UnixStream, mut to: UnixStream) {
    let mut some = [0; 1 << 14];
    while let Ok(read) = from.read(&mut some) {
        if read == 0 || to.write_all(&some[..read]).is_err() {
            break;
        }
    }
    let _ = [from, to].map(|line| line.shutdown(Shutdown::Both));
}
