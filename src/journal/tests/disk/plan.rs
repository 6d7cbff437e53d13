//! What a disk is told to do, and how often it was asked.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use crate::image::{Cut, Image};
use crate::seeded_numbers::SeededNumbers;
use crate::vfs;

/// What SQLite asks of its files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Operation {
    /// To open a file, or make it.
    Open,
    /// To read bytes.
    Read,
    /// To write bytes.
    Write,
    /// To change the length of a file.
    Truncate,
    /// To bring a file to the disk.
    Sync,
    /// To tell the length of a file.
    Size,
    /// To lock the database.
    Lock,
    /// To lock a part of the index of the log.
    IndexLock,
    /// To map a part of the index of the log into memory.
    IndexMap,
    /// To delete a file.
    Delete,
    /// To tell whether a file is there.
    Access,
}

impl Operation {
    /// All there are.
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

    /// The faults that it can have, each with a share of chance where it needs one; a stall left out.
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

/// What is wrong with an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It fails, and nothing is done: an error of input or output, a file that cannot be opened.
    Error,
    /// It fails for want of room, and nothing is done.
    Full,
    /// A write fails for want of room after a share of the bytes, which follows from the number.
    Torn(u64),
    /// It is done, and fails all the same: nobody knows what became of it.
    Late,
    /// A sync fails, and what it should have brought to the disk is given up: by chance it is there or not, and no later sync brings it.
    Forget(u64),
    /// Another process has the lock.
    Busy,
    /// A read gives zeros from some byte on, and says nothing.
    Zeros(u64),
    /// A read gives a bit that is wrong, and says nothing.
    Flipped(u64),
}

/// What waits for an operation.
enum Waiting {
    Fault(Fault),
    Stall(Sender<()>, Receiver<()>),
}

/// What becomes of an operation.
pub(crate) enum Verdict {
    Done,
    Wrong(Fault),
}

struct Planned {
    operation: Operation,
    /// The operations of that kind that are done before it strikes.
    after: u64,
    /// How often it strikes.
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

/// What SQLite and the test share of a disk.
pub(crate) struct Shared {
    folder: PathBuf,
    /// Pages in the log after which it is brought into the database.
    pub(crate) checkpoint_pages: u32,
    state: Mutex<State>,
}

static DISKS: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());

/// A test that failed has said why; the others go on.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the disk under a file.
pub(crate) fn disk_of(path: &Path) -> Option<Arc<Shared>> {
    let folder = path.parent()?;
    locked(&DISKS).iter().filter_map(Weak::upgrade).find(|disk| disk.folder == folder)
}

/// The disk under one folder; with it the faults go.
pub struct Disk(Arc<Shared>);

/// A disk that blocks in an operation until it is let go, by [`Stall::release`] or by dropping this.
pub struct Stall {
    reached: Receiver<()>,
    go: Sender<()>,
}

impl Stall {
    /// Waits until the operation is reached. Returns false if it never will be.
    pub fn is_reached(&self) -> bool {
        self.reached.recv().is_ok()
    }

    /// Lets the operation go on.
    pub fn release(self) {
        // Where nobody waits any more, nobody has to be told.
        let _ = self.go.send(());
    }
}

impl Disk {
    /// Lays a disk under a folder, which is made if it is not there. The log of a database in it is brought into the database whenever it
    /// has so many pages: a short life sees it too.
    ///
    /// # Panics
    /// A folder that cannot be made.
    pub fn under(folder: &Path, checkpoint_pages: u32) -> Self {
        Self::laid(folder, checkpoint_pages, None)
    }

    /// As [`Disk::under`], and the disk keeps what it would hold if the power went, at each change of a file.
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

    /// Returns how many operations of a kind there were.
    pub fn asked(&self, operation: Operation) -> u64 {
        locked(&self.0.state).asked.get(&operation).copied().unwrap_or(0)
    }

    /// Lets so many operations of a kind pass from here on, and spoils those that follow them, as many times as wanted; [`u64::MAX`] is for ever.
    /// It takes the place of what was planned before.
    pub fn spoil(&self, operation: Operation, after: u64, times: u64, fault: Fault) {
        self.plan(operation, after, times, Waiting::Fault(fault));
    }

    /// Lets so many operations of a kind pass from here on, and blocks in the next.
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

    /// Ends what was planned.
    pub fn heal(&self) {
        locked(&self.0.state).planned = None;
    }

    /// Returns how often what was planned has struck.
    pub fn struck(&self) -> u64 {
        locked(&self.0.state).struck
    }

    /// Marks all cuts that follow.
    pub fn mark(&self, mark: u64) {
        locked(&self.0.state).mark = mark;
    }

    /// Returns the cuts so far, the last of them as things stand now, and begins with none again.
    pub fn cuts(&self) -> Vec<Cut> {
        self.0.cut(|| "nothing".to_owned());
        std::mem::take(&mut locked(&self.0.state).cuts)
    }
}

impl Shared {
    /// Tells what becomes of the next operation of a kind. Blocks in one that stalls.
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

    /// Changes what the disk holds.
    pub(crate) fn change<T>(&self, change: impl FnOnce(&mut Image) -> T) -> Option<T> {
        locked(&self.state).image.as_mut().map(change)
    }

    /// Lays a cut by.
    pub(crate) fn cut(&self, during: impl FnOnce() -> String) {
        let mut state = locked(&self.state);
        let Some(image) = state.image.clone() else { return };
        let mut others = BTreeMap::new();
        files_below(&self.folder, Path::new(""), &mut others);
        let mark = state.mark;
        state.cuts.push(Cut { during: during(), mark, image, others: Arc::new(others) });
    }
}

/// Reads the files that SQLite does not know. Those that it does know are left alone: whoever closes one gives its locks back.
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
