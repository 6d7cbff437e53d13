//! Opens the database, and checks that it is a journal and that its settings give the promised durability.

use std::fs::{self, File};
use std::io::Read;
use std::path::Path;
use std::time::Duration;

use rusqlite::config::DbConfig;
use rusqlite::{Connection, OpenFlags};

use super::error::JournalError;
use super::names::DATABASE;
use super::system;

/// Application id `RGrd` in the header of the file; identifies a journal of Regrind.
const APPLICATION_ID: u32 = 0x5247_7264;
/// Timeout of a write while another process locks the file. The caller of a failed write tries again.
const BUSY_FOR: Duration = Duration::from_millis(200);
/// Version of the table layout and its content. Version 1 has no seals; it can still be read.
const LAYOUT: u32 = 2;

pub(super) const SCHEMA: &str = "
CREATE TABLE record (
    seq INTEGER PRIMARY KEY,
    utc TEXT NOT NULL,
    boot_id TEXT NOT NULL,
    mono_ns INTEGER NOT NULL,
    actor TEXT NOT NULL,
    station TEXT NOT NULL,
    kind TEXT NOT NULL,
    part TEXT NOT NULL,
    cycle INTEGER NOT NULL,
    command_id INTEGER,
    reason TEXT NOT NULL,
    payload TEXT NOT NULL,
    prev_hash TEXT NOT NULL,
    hash TEXT NOT NULL UNIQUE
) STRICT;
CREATE INDEX record_command ON record (command_id, kind) WHERE command_id IS NOT NULL;
CREATE TRIGGER record_is_not_changed BEFORE UPDATE ON record BEGIN SELECT RAISE(ABORT, 'records are not changed'); END;
CREATE TRIGGER record_is_not_deleted BEFORE DELETE ON record BEGIN SELECT RAISE(ABORT, 'records are not deleted'); END;
CREATE TRIGGER record_follows_the_last BEFORE INSERT ON record
    WHEN NEW.seq IS NOT (SELECT coalesce(max(seq), 0) + 1 FROM record)
    BEGIN SELECT RAISE(ABORT, 'records follow the last'); END;
";

/// Creates the database of a new journal in `folder`, and opens it for writing.
pub(super) fn create(folder: &Path) -> Result<Connection, JournalError> {
    let path = folder.join(DATABASE);
    let failed = JournalError::database(&path);
    let connection = Connection::open(&path).map_err(&failed)?;
    let marks = format!("PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {LAYOUT};");
    connection.execute_batch(&format!("BEGIN IMMEDIATE; {marks} {SCHEMA} COMMIT;")).map_err(&failed)?;
    configure(&connection, &path)?;
    keep_the_log(&connection, true).map_err(&failed)?;
    Ok(connection)
}

/// Sets what SQLite does with the write-ahead log when the database is closed. If `keeps` is true, the log file stays.
/// If `keeps` is false, the content of the log is written into the database, and the log file is deleted. After a
/// crash, the log file stays in both cases.
pub(super) fn keep_the_log(connection: &Connection, keeps: bool) -> rusqlite::Result<()> {
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, keeps).map(drop)
}

/// Opens the database of a run for writing. Then writes the content of the write-ahead log into the database file.
///
/// # Errors
/// The folder has no journal; the file is not a journal, or was written by a later version; a setting cannot be
/// applied.
pub(super) fn read_write(folder: &Path) -> Result<Connection, JournalError> {
    let path = folder.join(DATABASE);
    let layout = recognise(folder, &path)?;
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let failed = JournalError::database(&path);
    let connection = Connection::open_with_flags(&path, flags).map_err(&failed)?;
    configure(&connection, &path)?;
    check_schema(&connection, &path)?;
    checkpoint_log(&connection).map_err(&failed)?;
    keep_the_log(&connection, true).map_err(&failed)?;
    if layout < LAYOUT {
        // An earlier version may not know the records that are written from here on.
        connection.execute_batch(&format!("PRAGMA user_version = {LAYOUT};")).map_err(&failed)?;
    }
    Ok(connection)
}

/// Writes the whole write-ahead log into the database file (a checkpoint). The next record is then written at the
/// beginning of the log. Does nothing while another process reads the database.
///
/// The checkpoint protects against an earlier failed flush. After such a failure, the operating system can discard a
/// part of the log that is not yet on the disk, and still show that part to readers. A power failure would then make
/// all later records in the log unreadable.
fn checkpoint_log(connection: &Connection) -> rusqlite::Result<()> {
    // RESTART keeps the length of the log file. A missing or empty log of an interrupted run therefore shows that
    // somebody removed it.
    run(connection, "PRAGMA wal_checkpoint(RESTART)")
}

/// Returns an error if the database contains a table, view, index or trigger that a journal does not have, or if the
/// table of records is missing. This protects the reader: a view with the name of the table could return any rows, even
/// without end.
fn check_schema(connection: &Connection, path: &Path) -> Result<(), JournalError> {
    let failed = JournalError::database(path);
    let mut statement = connection.prepare("SELECT type, name, sql FROM sqlite_schema").map_err(&failed)?;
    let mut rows = statement.query([]).map_err(&failed)?;
    let foreign = |what| JournalError::Foreign { path: path.to_owned(), what };
    let mut has_table = false;
    while let Some(row) = rows.next().map_err(&failed)? {
        let (kind, name): (String, String) = (row.get(0).map_err(&failed)?, row.get(1).map_err(&failed)?);
        let sql: Option<String> = row.get(2).map_err(&failed)?;
        // SQLite creates an index of its own for each UNIQUE column.
        let is_automatic = sql.is_none() && kind == "index" && name.starts_with("sqlite_autoindex_record_");
        if !is_automatic && !sql.is_some_and(|sql| statements().any(|known| known == words(&sql))) {
            return Err(foreign("it has a table, view, index or trigger that does not belong to a record"));
        }
        has_table |= kind == "table" && name == "record";
    }
    if has_table { Ok(()) } else { Err(foreign("it has no table of records")) }
}

/// Returns the SQL statements that create the tables, indices and triggers of a journal. Each sequence of white space
/// is replaced by one blank. The statements can then be compared with the statements that an existing database
/// contains.
fn statements() -> impl Iterator<Item = String> {
    // The statement of a trigger contains a semicolon, so the schema is not split at semicolons.
    SCHEMA
        .split("\nCREATE ")
        .skip(1)
        .map(|statement| words(&format!("CREATE {}", statement.trim().trim_end_matches(';'))))
}

fn words(sql: &str) -> String {
    sql.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Opens the database of a run for reading. The folder need not be writable.
///
/// # Errors
/// The folder has no journal; the file is not a journal, or was written by a later version.
pub(super) fn read_only(folder: &Path) -> Result<Connection, JournalError> {
    let path = folder.join(DATABASE);
    recognise(folder, &path)?;
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let failed = JournalError::database(&path);
    let tried = Connection::open_with_flags(&path, flags).and_then(|c| reads(&c).map(|()| c));
    let is_beside = |what: &str| folder.join(format!("{DATABASE}-{what}")).exists();
    let connection = match tried {
        // Only a writer can roll back uncommitted content of the file.
        Err(error) if is_unopenable(&error) && is_beside("journal") => {
            return Err(JournalError::Foreign {
                path,
                what: "its creation was interrupted, and nothing in it was committed",
            });
        }
        Err(error) if is_unopenable(&error) && !is_beside("wal") => {
            // A WAL database needs files next to it. If they cannot be created and there is no log, the database is
            // read as it is.
            let address = address(&path);
            let flags = flags | OpenFlags::SQLITE_OPEN_URI;
            Connection::open_with_flags(address, flags).and_then(|c| reads(&c).map(|()| c))
        }
        other => other,
    }
    .map_err(&failed)?;
    harden(&connection, &path)?;
    check_schema(&connection, &path)?;
    Ok(connection)
}

fn reads(connection: &Connection) -> rusqlite::Result<()> {
    connection.query_row("SELECT count(*) FROM sqlite_schema", [], |_| Ok(()))
}

fn is_unopenable(error: &rusqlite::Error) -> bool {
    matches!(
        error.sqlite_error_code(),
        Some(rusqlite::ErrorCode::CannotOpen | rusqlite::ErrorCode::ReadOnly | rusqlite::ErrorCode::PermissionDenied)
    )
}

/// Returns the SQLite URI that opens the file at `path` as immutable: without locks and without a log.
fn address(path: &Path) -> String {
    let mut address = "file:".to_owned();
    for byte in path.as_os_str().as_encoded_bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => address.push(char::from(*byte)),
            byte => address.push_str(&format!("%{byte:02X}")),
        }
    }
    address + "?immutable=1"
}

/// Checks the header of the database file `path`, before SQLite opens the file. Returns the version of the table layout
/// from the header. `folder` is the run folder, for messages.
///
/// A process that has the journal in this folder open for writing must not call this function. The function opens and
/// closes the file. A process that closes a file releases all its locks on that file.
///
/// # Errors
/// The file does not exist; it is not a journal; it was written by a later version.
fn recognise(folder: &Path, path: &Path) -> Result<u32, JournalError> {
    if !path.is_file() {
        return Err(JournalError::Absent { path: folder.to_owned() });
    }
    for beside in ["-wal", "-shm", "-journal"] {
        let beside = folder.join(format!("{DATABASE}{beside}"));
        if fs::symlink_metadata(&beside).is_ok_and(|found| !found.is_file()) {
            return Err(JournalError::Foreign { path: beside, what: "it is not a file" });
        }
    }
    let failed = JournalError::file(path, "reading it");
    let mut header = Vec::new();
    File::open(path).map_err(&failed)?.take(100).read_to_end(&mut header).map_err(&failed)?;
    let foreign = |what| Err(JournalError::Foreign { path: path.to_owned(), what });
    if header.len() < 100 || !header.starts_with(b"SQLite format 3\0") {
        return foreign("it is not an SQLite database");
    }
    let word = |at: usize| header[at..at + 4].iter().fold(0, |word: u32, byte| word << 8 | u32::from(*byte));
    if word(68) != APPLICATION_ID {
        return foreign("it is a database of another program");
    }
    match word(60) {
        layout @ 1..=LAYOUT => Ok(layout),
        found => Err(JournalError::Newer { path: path.to_owned(), found, limit: LAYOUT }),
    }
}

/// Applies the SQLite settings of a journal: the timeout for a busy database, the write-ahead log, a flush to the disk
/// after every transaction, foreign keys, and protection against a manipulated database file. Reads back each setting
/// that is a `PRAGMA`, to check that SQLite accepted it. `path` only names the database in messages.
///
/// # Errors
/// [`JournalError::Setting`] if the database did not accept a setting.
fn configure(connection: &Connection, path: &Path) -> Result<(), JournalError> {
    connection.busy_timeout(BUSY_FOR).map_err(JournalError::database(path))?;
    set(connection, path, "journal_mode", "wal")?;
    // 2 is FULL: a lower level can lose the last records in a power failure.
    set(connection, path, "synchronous", "2")?;
    set(connection, path, "foreign_keys", "1")?;
    harden(connection, path)
}

fn harden(connection: &Connection, path: &Path) -> Result<(), JournalError> {
    set(connection, path, "trusted_schema", "0")?;
    set(connection, path, "cell_size_check", "1")?;
    set(connection, path, "mmap_size", "0")
}

fn set(connection: &Connection, path: &Path, setting: &'static str, wanted: &'static str) -> Result<(), JournalError> {
    let failed = JournalError::database(path);
    run(connection, &format!("PRAGMA {setting} = {wanted}")).map_err(&failed)?;
    let found =
        connection.query_row(&format!("PRAGMA {setting}"), [], |row| row.get_ref(0).map(text_of)).map_err(&failed)?;
    if found == wanted { Ok(()) } else { Err(JournalError::Setting { path: path.to_owned(), setting, wanted, found }) }
}

/// Executes an SQL statement, and reads and discards all result rows. Reading to the end is necessary, because a
/// `PRAGMA` statement can return a row first and fail afterwards.
fn run(connection: &Connection, sql: &str) -> rusqlite::Result<()> {
    let mut statement = connection.prepare(sql)?;
    let mut rows = statement.query([])?;
    while rows.next()?.is_some() {}
    Ok(())
}

fn text_of(value: rusqlite::types::ValueRef<'_>) -> String {
    match value {
        rusqlite::types::ValueRef::Integer(number) => number.to_string(),
        rusqlite::types::ValueRef::Text(text) => String::from_utf8_lossy(text).into_owned(),
        other => format!("{:?}", other.data_type()),
    }
}

/// Flushes a folder to the disk, so that the names of its files last after a power failure.
pub(super) fn sync_folder(folder: &Path) -> Result<(), JournalError> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    system::sync_folder(folder).map_err(JournalError::file(folder, "flushing it to the disk"))
}

/// Returns true if a folder does not exist or is empty.
pub(super) fn is_free(folder: &Path) -> Result<bool, JournalError> {
    match fs::read_dir(folder) {
        Ok(mut entries) => Ok(entries.next().is_none()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(true),
        Err(error) => Err(JournalError::file(folder, "inspecting it")(error)),
    }
}

/// Returns true if every user of this computer can read or enter the run folder. This is a risk: a process that reads
/// the database can block the process that writes records. Returns false if the folder does not exist, and always on
/// Windows.
pub fn is_open_to_all(folder: &Path) -> bool {
    system::is_open_to_all(folder)
}

/// Returns the free space, in bytes, that the user of this program has on the disk of a folder. If the folder does not
/// exist, its nearest existing parent is used.
///
/// # Errors
/// The free space cannot be queried.
pub fn free_bytes(folder: &Path) -> Result<u64, JournalError> {
    let whole = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    let there = whole.ancestors().find(|folder| folder.is_dir()).unwrap_or(&whole);
    system::free_bytes(there).map_err(JournalError::file(there, "reading its free space"))
}
