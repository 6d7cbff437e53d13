//! Layer between SQLite and the system's own files.
//! It asks the disk for the fault of each operation, and forwards it.

use std::ffi::{CStr, OsStr, c_char, c_int, c_uint, c_void};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::ptr;
use std::slice;
use std::sync::{Arc, OnceLock};

use rusqlite::ffi::{self, sqlite3, sqlite3_file, sqlite3_io_methods, sqlite3_vfs};

use crate::plan::{Fault, Operation, Shared, Verdict, disk_of};
use crate::seeded_numbers::SeededNumbers;

/// File layer (VFS) of the system.
struct System(*mut sqlite3_vfs);

// SAFETY: SQLite never changes nor frees it, and its functions may be called from any thread.
unsafe impl Send for System {}
// SAFETY: as above.
unsafe impl Sync for System {}

static SYSTEM: OnceLock<System> = OnceLock::new();

/// Installs this layer, once, for all databases that are opened later.
pub(crate) fn install() {
    SYSTEM.get_or_init(|| {
        // SAFETY: the name is a string with its end, and what is found lives as long as the process.
        let system = unsafe { ffi::sqlite3_vfs_find(c"unix".as_ptr()) };
        assert!(!system.is_null(), "SQLite knows the files of this system");
        // SAFETY: it was found, and is plain numbers and functions.
        let mut layer = unsafe { *system };
        layer.szOsFile += size_of::<Layer>() as c_int;
        layer.zName = c"regrind-disk".as_ptr();
        layer.pNext = ptr::null_mut();
        layer.xOpen = Some(open);
        layer.xDelete = Some(delete);
        layer.xAccess = Some(access);
        layer.xSleep = Some(sleep);
        // SAFETY: what is registered is never freed. The functions that were not replaced look at `pAppData` at most,
        // which is theirs.
        let registered = unsafe { ffi::sqlite3_vfs_register(Box::leak(Box::new(layer)), 1) };
        assert_eq!(registered, ffi::SQLITE_OK);
        // SAFETY: the function has the form that is asked for, and is there as long as the process.
        let registered = unsafe { ffi::sqlite3_auto_extension(Some(opened)) };
        assert_eq!(registered, ffi::SQLITE_OK);
        System(system)
    });
}

fn system() -> *mut sqlite3_vfs {
    SYSTEM.get().expect("installed before anything is opened").0
}

/// Registers `begun` for the statements of each connection on a disk.
/// SQLite would overwrite a number of checkpoint pages that is set here.
unsafe extern "C" fn opened(
    connection: *mut sqlite3,
    _: *mut *mut c_char,
    _: *const ffi::sqlite3_api_routines,
) -> c_int {
    // SAFETY: SQLite gives a connection that is open; the function has the form that is asked for, and gets that
    // connection.
    unsafe {
        match disk_of_connection(connection) {
            Some(_) => ffi::sqlite3_trace_v2(connection, ffi::SQLITE_TRACE_STMT as _, Some(begun), connection.cast()),
            None => ffi::SQLITE_OK,
        }
    }
}

/// Sets the number of log pages at which a connection runs a checkpoint.
unsafe extern "C" fn begun(_: c_uint, connection: *mut c_void, _: *mut c_void, _: *mut c_void) -> c_int {
    let connection = connection.cast();
    // SAFETY: the connection runs a statement, so it is open.
    unsafe {
        if let Some(disk) = disk_of_connection(connection) {
            ffi::sqlite3_wal_autocheckpoint(connection, disk.checkpoint_pages as c_int);
        }
    }
    0
}

/// Returns the disk under the database of a connection.
///
/// # Safety
/// The connection is open.
unsafe fn disk_of_connection(connection: *mut sqlite3) -> Option<Arc<Shared>> {
    // SAFETY: as the caller says; the name of its database lives as long as the connection.
    unsafe { path_of(ffi::sqlite3_db_filename(connection, c"main".as_ptr())) }.and_then(disk_of)
}

/// File as SQLite holds it. The system's own file follows it in memory.
/// SQLite allocates at multiples of eight bytes, as both files require.
#[repr(C)]
struct Layer {
    base: sqlite3_file,
    /// Null in a folder without a disk.
    watched: *mut Watched,
}

/// File in a folder with a disk.
struct Watched {
    disk: Arc<Shared>,
    path: PathBuf,
    /// Number of the file in the recorded content; `None` if the disk does not record its content.
    file: Option<usize>,
    /// True if its next sync also syncs the folder, as the system's layer does for a log that it has created.
    brings_folder: std::cell::Cell<bool>,
}

impl Watched {
    fn name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Returns the fault of an operation, if it has one.
    fn ask(&self, operation: Operation) -> Option<Fault> {
        match self.disk.ask(operation) {
            Verdict::Done => None,
            Verdict::Wrong(fault) => Some(fault),
        }
    }

    fn written(&self, at: u64, bytes: &[u8]) {
        let Some(file) = self.file else { return };
        self.disk.change(|image| image.written(file, at, bytes));
        self.disk.cut(|| format!("write of {} bytes at {at} of {}", bytes.len(), self.name()));
    }

    fn truncated(&self, length: u64) {
        let Some(file) = self.file else { return };
        self.disk.change(|image| image.truncated(file, length));
        self.disk.cut(|| format!("truncation of {} to {length}", self.name()));
    }

    /// Records a cut and then a sync. During the sync, any part of the written bytes can be on the disk.
    fn synced(&self, fault: Option<Fault>) {
        let Some(file) = self.file else { return };
        self.disk.cut(|| format!("sync of {}", self.name()));
        match fault {
            None | Some(Fault::Late) => {
                self.disk.change(|image| {
                    image.synced(file);
                    if self.brings_folder.replace(false) {
                        image.folder_synced();
                    }
                });
            }
            Some(Fault::Forget(chance)) => {
                self.disk.change(|image| image.forgotten(file, &mut SeededNumbers::new(chance)));
            }
            Some(_) => {}
        }
    }
}

/// Returns a name from SQLite as a path.
///
/// # Safety
/// The name is null or a string with its end, and outlives the returned path.
unsafe fn path_of<'a>(name: *const c_char) -> Option<&'a Path> {
    if name.is_null() {
        return None;
    }
    // SAFETY: as the caller says.
    let name = unsafe { CStr::from_ptr(name) };
    Some(Path::new(OsStr::from_bytes(name.to_bytes())))
}

/// Returns the disk data of an open file, if its folder has a disk.
///
/// # Safety
/// The file was opened by [`open`] and is not closed.
unsafe fn watched<'a>(file: *mut sqlite3_file) -> Option<&'a Watched> {
    // SAFETY: `open` put it there, and `close` takes it away.
    unsafe { (*file.cast::<Layer>()).watched.as_ref() }
}

/// Returns the system's own file.
///
/// # Safety
/// The allocated memory contains a [`Layer`] and a file of the system.
unsafe fn below(file: *mut sqlite3_file) -> *mut sqlite3_file {
    // SAFETY: SQLite gives every file the room that was asked for in `szOsFile`.
    unsafe { file.cast::<Layer>().add(1).cast() }
}

/// Forwards an operation to the system's own file.
/// The operations of the log index are missing in files that no other process shares.
macro_rules! hand_on {
    ($file:expr, $operation:ident $(, $argument:expr)*) => {{
        // SAFETY: the file is open, so its own functions are there, and they get what SQLite gave.
        unsafe {
            let below = below($file);
            match (*(*below).pMethods).$operation {
                Some(operation) => operation(below $(, $argument)*),
                None => ffi::SQLITE_IOERR,
            }
        }
    }};
}

// ---- files by their names ----------------------------------------------------------------------------------------------------------------

unsafe extern "C" fn open(
    _: *mut sqlite3_vfs,
    name: ffi::sqlite3_filename,
    file: *mut sqlite3_file,
    flags: c_int,
    flags_out: *mut c_int,
) -> c_int {
    let layer = file.cast::<Layer>();
    // SAFETY: SQLite gives the room, and closes no file without functions.
    unsafe { layer.write(Layer { base: sqlite3_file { pMethods: ptr::null() }, watched: ptr::null_mut() }) };
    // SAFETY: SQLite's names are null or strings with an end.
    let path = unsafe { path_of(name) };
    let disk = path.and_then(disk_of);
    if let Some(disk) = &disk
        && let Verdict::Wrong(_) = disk.ask(Operation::Open)
    {
        return ffi::SQLITE_CANTOPEN;
    }
    let was_there = path.is_some_and(Path::exists);
    // SAFETY: the system's own function gets its own room, and what SQLite gave.
    let done = unsafe { (*system()).xOpen.map(|open| open(system(), name, below(file), flags, flags_out)) };
    if done != Some(ffi::SQLITE_OK) {
        return done.unwrap_or(ffi::SQLITE_CANTOPEN);
    }
    if let (Some(disk), Some(path)) = (disk, path) {
        let is_log = flags & (ffi::SQLITE_OPEN_MAIN_JOURNAL | ffi::SQLITE_OPEN_WAL) != 0;
        let number = disk.remembers().then(|| known(&disk, path, file, was_there)).flatten();
        let brings_folder = (is_log && !was_there).into();
        let watched = Watched { disk, path: path.to_owned(), file: number, brings_folder };
        // SAFETY: it was written above.
        unsafe { (*layer).watched = Box::into_raw(Box::new(watched)) };
    }
    // SAFETY: as above.
    unsafe { (*layer).base.pMethods = &METHODS };
    ffi::SQLITE_OK
}

/// Returns the number of a file in the recorded content of a disk. Adds the file if it is new.
fn known(disk: &Shared, path: &Path, file: *mut sqlite3_file, was_there: bool) -> Option<usize> {
    if !was_there {
        let made = disk.change(|image| image.made(path));
        disk.cut(|| format!("creation of {}", path.display()));
        return made;
    }
    if let Some(found) = disk.change(|image| image.find(path)).flatten() {
        return Some(found);
    }
    let bytes = whole(file);
    disk.change(|image| image.found(path, bytes))
}

/// Reads a file through its open descriptor. Closing another descriptor would release the locks of this process.
fn whole(file: *mut sqlite3_file) -> Vec<u8> {
    let mut size = 0;
    let asked = hand_on!(file, xFileSize, &mut size);
    assert_eq!(asked, ffi::SQLITE_OK, "the length of a file that was opened");
    let mut bytes = vec![0; size as usize];
    let read = hand_on!(file, xRead, bytes.as_mut_ptr().cast(), bytes.len() as c_int, 0);
    assert_eq!(read, ffi::SQLITE_OK, "the bytes of a file that was opened");
    bytes
}

unsafe extern "C" fn delete(_: *mut sqlite3_vfs, name: *const c_char, sync_folder: c_int) -> c_int {
    // SAFETY: SQLite's names are null or strings with an end.
    let path = unsafe { path_of(name) };
    let disk = path.and_then(disk_of);
    let fault = disk.as_ref().and_then(|disk| match disk.ask(Operation::Delete) {
        Verdict::Done => None,
        Verdict::Wrong(fault) => Some(fault),
    });
    if matches!(fault, Some(Fault::Error)) {
        return ffi::SQLITE_IOERR_DELETE;
    }
    if let (Some(disk), Some(path)) = (&disk, path) {
        disk.change(|image| image.deleted(path));
        disk.cut(|| format!("deletion of {}", path.display()));
    }
    // SAFETY: the system's own function gets what SQLite gave.
    let deleted = unsafe { (*system()).xDelete.map(|delete| delete(system(), name, sync_folder)) };
    if let Some(disk) = disk.filter(|_| sync_folder != 0) {
        disk.change(|image| image.folder_synced());
    }
    if fault.is_some() { ffi::SQLITE_IOERR_DELETE } else { deleted.unwrap_or(ffi::SQLITE_IOERR_DELETE) }
}

unsafe extern "C" fn access(_: *mut sqlite3_vfs, name: *const c_char, flags: c_int, found: *mut c_int) -> c_int {
    // SAFETY: SQLite's names are null or strings with an end.
    let disk = unsafe { path_of(name) }.and_then(disk_of);
    if disk.is_some_and(|disk| matches!(disk.ask(Operation::Access), Verdict::Wrong(_))) {
        return ffi::SQLITE_IOERR_ACCESS;
    }
    // SAFETY: the system's own function gets what SQLite gave.
    unsafe { (*system()).xAccess.map_or(ffi::SQLITE_IOERR_ACCESS, |access| access(system(), name, flags, found)) }
}

/// Yields the thread instead of sleeping, and reports the full sleep time to SQLite.
/// A connection that waits for a lock retries at once, and as often as with a real sleep.
unsafe extern "C" fn sleep(_: *mut sqlite3_vfs, microseconds: c_int) -> c_int {
    std::thread::yield_now();
    microseconds
}

// ---- files that are open -----------------------------------------------------------------------------------------------------------------

static METHODS: sqlite3_io_methods = sqlite3_io_methods {
    // Without mapped files, which is the third version.
    iVersion: 2,
    xClose: Some(close),
    xRead: Some(read),
    xWrite: Some(write),
    xTruncate: Some(truncate),
    xSync: Some(sync),
    xFileSize: Some(file_size),
    xLock: Some(lock),
    xUnlock: Some(unlock),
    xCheckReservedLock: Some(check_reserved_lock),
    xFileControl: Some(file_control),
    xSectorSize: Some(sector_size),
    xDeviceCharacteristics: Some(device_characteristics),
    xShmMap: Some(index_map),
    xShmLock: Some(index_lock),
    xShmBarrier: Some(index_barrier),
    xShmUnmap: Some(index_unmap),
    xFetch: None,
    xUnfetch: None,
};

unsafe extern "C" fn close(file: *mut sqlite3_file) -> c_int {
    let closed = hand_on!(file, xClose);
    // SAFETY: SQLite closes a file once; what was put there by `open` is taken away here.
    unsafe {
        let watched = std::mem::replace(&mut (*file.cast::<Layer>()).watched, ptr::null_mut());
        if !watched.is_null() {
            drop(Box::from_raw(watched));
        }
    }
    closed
}

unsafe extern "C" fn read(file: *mut sqlite3_file, to: *mut c_void, length: c_int, at: i64) -> c_int {
    // SAFETY: the file is open.
    let fault = unsafe { watched(file) }.and_then(|watched| watched.ask(Operation::Read));
    if matches!(fault, Some(Fault::Error)) {
        return ffi::SQLITE_IOERR_READ;
    }
    let read = hand_on!(file, xRead, to, length, at);
    // SAFETY: SQLite gives room for so many bytes, and the system has filled it, with zeros where the file has ended.
    let bytes = unsafe { slice::from_raw_parts_mut(to.cast::<u8>(), length as usize) };
    match fault {
        Some(Fault::Zeros(chance)) => bytes[chance as usize % length as usize..].fill(0),
        Some(Fault::Flipped(chance)) => bytes[chance as usize / 8 % length as usize] ^= 1 << (chance % 8),
        _ => {}
    }
    read
}

unsafe extern "C" fn write(file: *mut sqlite3_file, from: *const c_void, length: c_int, at: i64) -> c_int {
    // SAFETY: the file is open.
    let Some(watched) = (unsafe { watched(file) }) else { return hand_on!(file, xWrite, from, length, at) };
    let fault = watched.ask(Operation::Write);
    let kept = match fault {
        None | Some(Fault::Late) => length,
        Some(Fault::Torn(chance)) => (chance % length as u64) as c_int,
        Some(_) => 0,
    };
    let mut done = ffi::SQLITE_OK;
    if kept > 0 {
        // SAFETY: SQLite gives so many bytes, and fewer are taken at most.
        watched.written(at as u64, unsafe { slice::from_raw_parts(from.cast(), kept as usize) });
        done = hand_on!(file, xWrite, from, kept, at);
    }
    match fault {
        None => done,
        Some(Fault::Full | Fault::Torn(_)) => ffi::SQLITE_FULL,
        Some(_) => ffi::SQLITE_IOERR_WRITE,
    }
}

unsafe extern "C" fn truncate(file: *mut sqlite3_file, length: i64) -> c_int {
    // SAFETY: the file is open.
    let Some(watched) = (unsafe { watched(file) }) else { return hand_on!(file, xTruncate, length) };
    let fault = watched.ask(Operation::Truncate);
    if matches!(fault, Some(Fault::Error)) {
        return ffi::SQLITE_IOERR_TRUNCATE;
    }
    watched.truncated(length as u64);
    let done = hand_on!(file, xTruncate, length);
    if fault.is_some() { ffi::SQLITE_IOERR_TRUNCATE } else { done }
}

unsafe extern "C" fn sync(file: *mut sqlite3_file, flags: c_int) -> c_int {
    // SAFETY: the file is open.
    let Some(watched) = (unsafe { watched(file) }) else { return hand_on!(file, xSync, flags) };
    // What would last is in the memory of the disk: no real one is waited for.
    let fault = watched.ask(Operation::Sync);
    watched.synced(fault);
    if fault.is_some() { ffi::SQLITE_IOERR_FSYNC } else { ffi::SQLITE_OK }
}

unsafe extern "C" fn file_size(file: *mut sqlite3_file, size: *mut i64) -> c_int {
    // SAFETY: the file is open.
    match unsafe { watched(file) }.and_then(|watched| watched.ask(Operation::Size)) {
        Some(_) => ffi::SQLITE_IOERR_FSTAT,
        None => hand_on!(file, xFileSize, size),
    }
}

unsafe extern "C" fn lock(file: *mut sqlite3_file, level: c_int) -> c_int {
    // SAFETY: the file is open.
    match unsafe { watched(file) }.and_then(|watched| watched.ask(Operation::Lock)) {
        Some(_) => ffi::SQLITE_BUSY,
        None => hand_on!(file, xLock, level),
    }
}

unsafe extern "C" fn unlock(file: *mut sqlite3_file, level: c_int) -> c_int {
    hand_on!(file, xUnlock, level)
}

unsafe extern "C" fn check_reserved_lock(file: *mut sqlite3_file, found: *mut c_int) -> c_int {
    hand_on!(file, xCheckReservedLock, found)
}

unsafe extern "C" fn file_control(file: *mut sqlite3_file, what: c_int, argument: *mut c_void) -> c_int {
    hand_on!(file, xFileControl, what, argument)
}

unsafe extern "C" fn sector_size(file: *mut sqlite3_file) -> c_int {
    hand_on!(file, xSectorSize)
}

unsafe extern "C" fn device_characteristics(file: *mut sqlite3_file) -> c_int {
    hand_on!(file, xDeviceCharacteristics)
}

// ---- the index of the log, which all who have the database open share ----------------------------------------------------------------------

unsafe extern "C" fn index_map(
    file: *mut sqlite3_file,
    page: c_int,
    size: c_int,
    extend: c_int,
    to: *mut *mut c_void,
) -> c_int {
    // SAFETY: the file is open.
    match unsafe { watched(file) }.and_then(|watched| watched.ask(Operation::IndexMap)) {
        Some(Fault::Full) => ffi::SQLITE_FULL,
        Some(_) => ffi::SQLITE_IOERR_SHMMAP,
        None => hand_on!(file, xShmMap, page, size, extend, to),
    }
}

unsafe extern "C" fn index_lock(file: *mut sqlite3_file, from: c_int, count: c_int, flags: c_int) -> c_int {
    let is_taken = flags & ffi::SQLITE_SHM_LOCK != 0;
    // SAFETY: the file is open.
    match unsafe { watched(file) }.filter(|_| is_taken).and_then(|watched| watched.ask(Operation::IndexLock)) {
        Some(_) => ffi::SQLITE_BUSY,
        None => hand_on!(file, xShmLock, from, count, flags),
    }
}

unsafe extern "C" fn index_barrier(file: *mut sqlite3_file) {
    // SAFETY: the file is open, so its own functions are there.
    unsafe {
        let below = below(file);
        if let Some(barrier) = (*(*below).pMethods).xShmBarrier {
            barrier(below);
        }
    }
}

unsafe extern "C" fn index_unmap(file: *mut sqlite3_file, delete: c_int) -> c_int {
    hand_on!(file, xShmUnmap, delete)
}
