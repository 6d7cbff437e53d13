//! Planned faults of a disk, and the number of its operations.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use crate::image::{Cut, Image};
use crate::seeded_numbers::SeededNumbers;
use crate::vfs;

/// File operation that SQLite requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Operation {
    /// Opens a file, or creates it.
    Open,
    /// Reads bytes.
    Read,
    /// Writes bytes.
    Write,
    /// Changes the length of a file.
    Truncate,
    /// Syncs a file to the disk.
    Sync,
    /// Reads the length of a file.
    Size,
    /// Locks the database.
    Lock,
    /// Locks a part of the index of the log.
    IndexLock,
    /// Maps a part of the index of the log into memory.
    IndexMap,
    /// Deletes a file.
    Delete,
    /// Checks whether a file exists.
    Access,
}

impl Operation {
    /// All operations.
    pub const ALL: [Self; 11] = [
        Self::Open,
        Self::Read,
        Self::Write,
        Self::Truncate,
        Self::Sync,
        Self::Size,
        Self::Lock,
        Self::IndexLock,
        Self::IndexMap,
        Self::Delete,
        Self::Access,
    ];

    /// Returns the faults that this operation can have, except a stall.
    /// Draws a random number for the faults that need one.
    pub fn faults(self, drawn: &mut SeededNumbers) -> Vec<Fault> {
        let chance = drawn.below(1 << 32);
        match self {
            Self::Write => vec![Fault::Error, Fault::Full, Fault::Torn(chance), Fault::Late],
            Self::Sync => vec![Fault::Error, Fault::Forget(chance), Fault::Late],
            Self::Truncate | Self::Delete => vec![Fault::Error, Fault::Late],
            Self::Lock | Self::IndexLock => vec![Fault::Busy],
            Self::IndexMap => vec![Fault::Error, Fault::Full],
            Self::Open | Self::Read | Self::Size | Self::Access => vec![Fault::Error],
        }
    }
}

/// Fault of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The operation fails and changes nothing: an I/O error, or a file that cannot be opened.
    Error,
    /// The operation fails because the disk is full, and changes nothing.
    Full,
    /// A write fails because the disk is full, after it has written a part of the bytes.
    /// The number determines the part.
    Torn(u64),
    /// The operation succeeds but returns an error. The caller cannot know its result.
    Late,
    /// A sync fails and drops its changes. Each change is on the disk or lost, by chance. No later sync writes it.
    Forget(u64),
    /// Another process has the lock.
    Busy,
    /// A read returns zeros from some byte on, without an error.
    Zeros(u64),
    /// A read returns one wrong bit, without an error.
    Flipped(u64),
}

/// Planned fault or stall of an operation.
enum Waiting {
    Fault(Fault),
    Stall(Sender<()>, Receiver<()>),
}

/// Result of an operation: done, or a fault.
pub(crate) enum Verdict {
    Done,
    Wrong(Fault),
}

struct Planned {
    operation: Operation,
    /// Number of operations of that kind that succeed before the fault or stall.
    after: u64,
    /// Number of operations that the fault or stall affects.
    times: u64,
    waiting: Waiting,
}

#[derive(Default)]
struct State {
    asked: BTreeMap<Operation, u64>,
    planned: Option<Planned>,
    struck: u64,
    image: Option<Image>,
    cuts: Vec<Cut>,
    mark: u64,
}

/// State of a disk, shared by SQLite and the test.
pub(crate) struct Shared {
    folder: PathBuf,
    /// Number of pages in the log that starts a checkpoint.
    pub(crate) checkpoint_pages: u32,
    state: Mutex<State>,
}

static DISKS: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());

/// Locks a mutex, even if a failed test has poisoned it, so that the other tests continue.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the disk of a file, if its folder has one.
pub(crate) fn disk_of(path: &Path) -> Option<Arc<Shared>> {
    let folder = path.parent()?;
    locked(&DISKS).iter().filter_map(Weak::upgrade).find(|disk| disk.folder == folder)
}

/// Simulated disk of one folder. Its faults end when it is dropped.
pub struct Disk(Arc<Shared>);

/// Handle of an operation that blocks until [`Stall::release`], or until this handle is dropped.
pub struct Stall {
    reached: Receiver<()>,
    go: Sender<()>,
}

impl Stall {
    /// Waits until the operation begins. Returns false if it can no longer begin.
    pub fn is_reached(&self) -> bool {
        self.reached.recv().is_ok()
    }

    /// Lets the operation continue.
    pub fn release(self) {
        // Where nobody waits any more, nobody has to be told.
        let _ = self.go.send(());
    }
}

impl Disk {
    /// Installs a disk under a folder, and creates the folder if it does not exist.
    /// SQLite runs a checkpoint whenever the log of a database has this number of pages.
    /// A short test then has checkpoints too.
    ///
    /// # Panics
    /// The folder cannot be created.
    pub fn under(folder: &Path, checkpoint_pages: u32) -> Self {
        Self::laid(folder, checkpoint_pages, None)
    }

    /// Installs a disk as [`Disk::under`] does.
    /// At each change of a file, the disk also records its content for a power cut.
    ///
    /// # Panics
    /// As [`Disk::under`].
    pub fn remembering(folder: &Path, checkpoint_pages: u32) -> Self {
        Self::laid(folder, checkpoint_pages, Some(Image::default()))
    }

    fn laid(folder: &Path, checkpoint_pages: u32, image: Option<Image>) -> Self {
        vfs::install();
        fs::create_dir_all(folder).expect("the folder can be made");
        let folder = folder.canonicalize().expect("the folder is there");
        let state = Mutex::new(State { image, ..State::default() });
        let shared = Arc::new(Shared { folder, checkpoint_pages, state });
        let mut disks = locked(&DISKS);
        disks.retain(|disk| disk.strong_count() > 0);
        disks.push(Arc::downgrade(&shared));
        Self(shared)
    }

    /// Returns the number of operations of a kind that SQLite has requested.
    pub fn asked(&self, operation: Operation) -> u64 {
        locked(&self.0.state).asked.get(&operation).copied().unwrap_or(0)
    }

    /// Lets the next `after` operations of a kind succeed.
    /// Then the fault affects `times` operations; [`u64::MAX`] means all.
    /// Replaces the earlier plan.
    pub fn spoil(&self, operation: Operation, after: u64, times: u64, fault: Fault) {
        self.plan(operation, after, times, Waiting::Fault(fault));
    }

    /// Lets the next `after` operations of a kind succeed, and blocks in the one that follows.
    /// Replaces the earlier plan.
    pub fn stall(&self, operation: Operation, after: u64) -> Stall {
        let ((told, reached), (go, waits)) = (channel(), channel());
        self.plan(operation, after, 1, Waiting::Stall(told, waits));
        Stall { reached, go }
    }

    fn plan(&self, operation: Operation, after: u64, times: u64, waiting: Waiting) {
        let mut state = locked(&self.0.state);
        state.struck = 0;
        state.planned = Some(Planned { operation, after, times, waiting });
    }

    /// Removes the planned fault or stall.
    pub fn heal(&self) {
        locked(&self.0.state).planned = None;
    }

    /// Returns how often the planned fault or stall has occurred.
    pub fn struck(&self) -> u64 {
        locked(&self.0.state).struck
    }

    /// Sets the mark of all later cuts.
    pub fn mark(&self, mark: u64) {
        locked(&self.0.state).mark = mark;
    }

    /// Returns the recorded cuts and clears the list. The last cut has the present content of the disk.
    pub fn cuts(&self) -> Vec<Cut> {
        self.0.cut(|| "nothing".to_owned());
        std::mem::take(&mut locked(&self.0.state).cuts)
    }
}

impl Shared {
    /// Counts an operation and returns its result by the plan. Blocks if the plan is a stall.
    pub(crate) fn ask(&self, operation: Operation) -> Verdict {
        let mut state = locked(&self.state);
        *state.asked.entry(operation).or_default() += 1;
        let Some(planned) = state.planned.as_mut().filter(|planned| planned.operation == operation) else {
            return Verdict::Done;
        };
        if planned.after > 0 {
            planned.after -= 1;
            return Verdict::Done;
        }
        planned.times -= 1;
        let is_last = planned.times == 0;
        let fault = match &planned.waiting {
            Waiting::Fault(fault) => Some(*fault),
            Waiting::Stall(..) => None,
        };
        let planned = if is_last { state.planned.take() } else { None };
        state.struck += 1;
        drop(state);
        if let Some(Planned { waiting: Waiting::Stall(told, waits), .. }) = planned {
            // A test that has ended lets go.
            let _ = told.send(()).is_ok_and(|()| waits.recv().is_ok());
        }
        fault.map_or(Verdict::Done, Verdict::Wrong)
    }

    pub(crate) fn remembers(&self) -> bool {
        locked(&self.state).image.is_some()
    }

    /// Changes the recorded content of the disk, if the disk records it.
    pub(crate) fn change<T>(&self, change: impl FnOnce(&mut Image) -> T) -> Option<T> {
        locked(&self.state).image.as_mut().map(change)
    }

    /// Records a cut, if the disk records its content.
    pub(crate) fn cut(&self, during: impl FnOnce() -> String) {
        let mut state = locked(&self.state);
        let Some(image) = state.image.clone() else { return };
        let mut others = BTreeMap::new();
        files_below(&self.folder, Path::new(""), &mut others);
        let mark = state.mark;
        state.cuts.push(Cut { during: during(), mark, image, others: Arc::new(others) });
    }
}

/// Reads the files that do not belong to SQLite.
/// Does not open a file of SQLite, because closing it would release the locks that this process has on it.
fn files_below(folder: &Path, below: &Path, found: &mut BTreeMap<PathBuf, Vec<u8>>) {
    for entry in fs::read_dir(folder.join(below)).into_iter().flatten().flatten() {
        let name = below.join(entry.file_name());
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => files_below(folder, &name, found),
            Ok(_) if !name.to_string_lossy().contains(".sqlite") => {
                found.extend(fs::read(entry.path()).map(|bytes| (name, bytes)));
            }
            _ => {}
        }
    }
}
