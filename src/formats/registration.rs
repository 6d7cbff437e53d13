//! Files of a registration: deviations, point clouds, JSON.
//!
//! Every file is written under a temporary name in the same folder, flushed to the disk and renamed. A reader sees
//! either the old file or the new one, complete, even after a loss of power.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use serde::Serialize;

use super::error::FormatError;
use super::system;
use regrind_core::geometry::Point;

/// First line of `deviations.csv`. These names are a contract.
const DEVIATIONS_HEADER: &str = "x_mm,y_mm,z_mm,nx,ny,nz,deviation_mm,used";

/// Number of rows that one thread formats at a time, and number of rows held in memory at a time.
const SHARE: usize = 4096;
const BATCH: usize = 16 * SHARE;

/// Result of the registration for one measured point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DeviationRow {
    /// Contact point, in the model frame.
    pub point_mm: [f64; 3],
    /// Unit normal of the nominal surface there, in the model frame, outward.
    pub normal: [f64; 3],
    /// Signed deviation along the normal: positive where material is proud of the nominal surface.
    pub deviation_mm: f64,
    /// True if the point took part in the fit.
    pub used: bool,
}

/// Writes `rows` to `path` (`deviations.csv`): the header `x_mm,y_mm,z_mm,nx,ny,nz,deviation_mm,used`, then one row per
/// measured point in the order given.
///
/// `used` is 1 or 0. The numbers have enough digits that reading them gives exactly the same values.
///
/// # Errors
/// A row that contains NaN or an infinity; a file that cannot be written. An existing file of that name is then
/// unchanged.
pub fn write_deviations(path: impl AsRef<Path>, rows: &[DeviationRow]) -> Result<(), FormatError> {
    write_rows(path.as_ref(), DEVIATIONS_HEADER, rows, |row| {
        let ([x, y, z], [nx, ny, nz]) = (row.point_mm, row.normal);
        ([x, y, z, nx, ny, nz, row.deviation_mm], Some(row.used))
    })
}

/// Reads the deviations of all measured points from the file `path`, which [`write_deviations`] wrote. Returns one row
/// per point, in the order of the file.
///
/// # Errors
/// A file that cannot be read, or that does not have the columns of [`write_deviations`]; a row that is not finite
/// numbers.
pub fn read_deviations(path: &Path) -> Result<Vec<DeviationRow>, FormatError> {
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    let text = fs::read_to_string(path).map_err(unreadable)?;
    let mut lines = text.lines().zip(1u64..).filter(|(line, _)| !line.starts_with('#') && !line.trim().is_empty());
    let unexpected = |(found, line): (&str, u64), expected: &str| FormatError::Unexpected {
        path: path.to_owned(),
        place: format!("line {line}"),
        expected: expected.to_owned(),
        found: found.chars().take(80).collect(),
    };
    match lines.next() {
        Some((DEVIATIONS_HEADER, _)) => {}
        Some(other) => return Err(unexpected(other, DEVIATIONS_HEADER)),
        None => return Err(FormatError::Empty { path: path.to_owned(), expected: "deviations" }),
    }
    lines.map(|line| deviation_row(line.0).ok_or_else(|| unexpected(line, "a point and its deviation"))).collect()
}

fn deviation_row(row: &str) -> Option<DeviationRow> {
    let (numbers, used) = row.trim().rsplit_once(',')?;
    let mut values = [0.0; 7];
    let mut cells = numbers.split(',');
    for value in &mut values {
        *value = cells.next()?.parse::<f64>().ok().filter(|value| value.is_finite())?;
    }
    let [x, y, z, nx, ny, nz, deviation_mm] = values;
    let used = match used {
        "1" => true,
        "0" => false,
        _ => return None,
    };
    cells.next().is_none().then_some(DeviationRow { point_mm: [x, y, z], normal: [nx, ny, nz], deviation_mm, used })
}

/// Writes `points` to `path` as comma-separated text, in millimetres, one point per line. `header` is written first; an
/// empty `header` is omitted.
///
/// # Errors
/// A coordinate that is NaN or infinite; a file that cannot be written. An existing file of that name is then
/// unchanged.
pub fn write_points(path: impl AsRef<Path>, header: &str, points: &[Point]) -> Result<(), FormatError> {
    write_rows(path.as_ref(), header, points, |point| ([point.x, point.y, point.z], None))
}

/// Writes `values` to `path` as text, one number per line. `header` is written first; an empty `header` is omitted.
///
/// # Errors
/// A value that is NaN or infinite; a file that cannot be written. An existing file of that name is then unchanged.
pub fn write_column(path: impl AsRef<Path>, header: &str, values: &[f64]) -> Result<(), FormatError> {
    write_rows(path.as_ref(), header, values, |value| ([*value], None))
}

/// Writes `value` as indented JSON to `path`, completely or not at all.
///
/// JSON has no NaN. A number that is NaN or infinite is written as `null`, without an error. Therefore the caller must
/// check the numbers.
///
/// # Errors
/// A value that JSON cannot express, such as a map whose keys are not text; a file that cannot be written.
pub fn write_json_atomic(path: impl AsRef<Path>, value: &impl Serialize) -> Result<(), FormatError> {
    let path = path.as_ref();
    let json = |source| FormatError::Json { path: path.to_owned(), source };
    let mut text = serde_json::to_vec_pretty(value).map_err(json)?;
    text.push(b'\n');
    write_atomic(path, &text)
}

/// Writes `bytes` to the file `path`, completely or not at all (atomically). Replaces an existing file. If an error
/// occurs while the bytes are written, an existing file stays unchanged.
///
/// # Errors
/// A file that cannot be written.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    let mut draft = Draft::create(path)?;
    draft.write(bytes)?;
    draft.publish()
}

/// Writes `bytes` to the file `path`, which only its owner can read, completely or not at all.
///
/// # Errors
/// The same as for [`write_atomic`].
pub fn write_private(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    let mut draft = Draft::create_private(path)?;
    draft.write(bytes)?;
    draft.publish()
}

/// File for its owner alone that is on the disk, but has not its name yet.
pub struct PrivateDraft<'p>(Draft<'p>);

impl<'p> PrivateDraft<'p> {
    /// Writes `bytes` for the file `path`, which stays as it is until [`PrivateDraft::publish`]. Without that, nothing is
    /// left.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn create(path: &'p Path, bytes: &[u8]) -> Result<Self, FormatError> {
        let mut draft = Draft::create_private(path)?;
        draft.write(bytes)?;
        draft.flush()?;
        Ok(Self(draft))
    }

    /// Gives the file its name, in place of an existing file.
    ///
    /// # Errors
    /// A file that cannot be renamed or flushed to the disk.
    pub fn publish(self) -> Result<(), FormatError> {
        self.0.publish()
    }
}

/// Checks that files can be written to a folder.
///
/// # Errors
/// A folder that does not exist or is not writable.
pub fn try_writing(folder: &Path) -> Result<(), FormatError> {
    // A draft that is not published leaves no file.
    Draft::create(&folder.join("probe")).map(drop)
}

/// Writes a table to the file `path`, with commas between the columns. The first line is `header`, and one line per
/// item of `rows` follows. The function `cells` returns the numbers of one row, and a flag or `None`. A flag is written
/// as an additional last column: 1 if it is true, 0 if it is false.
///
/// # Errors
/// A row with NaN or an infinity; a file that cannot be written.
pub(super) fn write_rows<T: Sync, const N: usize>(
    path: &Path,
    header: &str,
    rows: &[T],
    cells: impl Fn(&T) -> ([f64; N], Option<bool>) + Sync,
) -> Result<(), FormatError> {
    let finite = |row: &T| cells(row).0.iter().all(|v| v.is_finite());
    if let Some(row) = rows.iter().position(|row| !finite(row)) {
        let value = cells(&rows[row]).0.into_iter().find(|v| !v.is_finite()).unwrap_or(f64::NAN);
        return Err(FormatError::RowNotFinite { path: path.to_owned(), row: row + 1, value });
    }
    let mut draft = Draft::create(path)?;
    if !header.is_empty() {
        draft.write(header.as_bytes())?;
        draft.write(b"\n")?;
    }
    for batch in rows.chunks(BATCH) {
        let texts: Vec<Vec<u8>> = batch.par_chunks(SHARE).map(|share| format_rows(share, &cells)).collect();
        for text in texts {
            draft.write(&text)?;
        }
    }
    draft.publish()
}

fn format_rows<T, const N: usize>(rows: &[T], cells: impl Fn(&T) -> ([f64; N], Option<bool>)) -> Vec<u8> {
    let mut text = Vec::with_capacity(rows.len() * (N * 22 + 2));
    let mut number = zmij::Buffer::new();
    for row in rows {
        let (values, flag) = cells(row);
        for value in values {
            text.extend_from_slice(number.format_finite(value).as_bytes());
            text.push(b',');
        }
        match flag {
            Some(flag) => text.push(b'0' + u8::from(flag)),
            None => drop(text.pop()),
        }
        text.push(b'\n');
    }
    text
}

/// File under a temporary name, which is removed unless it is published.
pub(super) struct Draft<'p> {
    path: &'p Path,
    temporary: PathBuf,
    file: BufWriter<File>,
    published: bool,
}

impl<'p> Draft<'p> {
    pub(super) fn create(path: &'p Path) -> Result<Self, FormatError> {
        Self::create_by(path, |temporary| OpenOptions::new().write(true).create_new(true).open(temporary))
    }

    /// Creates a temporary file in the folder of `path`. Only the owner can read the temporary file. [`Self::publish`]
    /// renames the temporary file to `path`. If `publish` is not called, the temporary file is removed when this value
    /// is dropped. Returns an error if `path` is a folder, a device or a pipe, or if the file cannot be created.
    pub(super) fn create_private(path: &'p Path) -> Result<Self, FormatError> {
        Self::create_by(path, system::create_owners)
    }

    fn create_by(path: &'p Path, create: fn(&Path) -> io::Result<File>) -> Result<Self, FormatError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let failed = |source| FormatError::Unwritable { path: path.to_owned(), action: "creating it", source };
        if path.is_dir() {
            return Err(failed(io::Error::from(io::ErrorKind::IsADirectory)));
        }
        // Publishing would replace a device or a pipe by a regular file.
        if path.metadata().is_ok_and(|there| !there.is_file()) {
            return Err(failed(io::Error::new(io::ErrorKind::InvalidInput, "it is a device or a pipe, not a file")));
        }
        let name = path.file_name().ok_or_else(|| failed(io::Error::from(io::ErrorKind::InvalidFilename)))?;
        let mut hidden = std::ffi::OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}-{}.tmp", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed)));
        let temporary = path.with_file_name(hidden);
        let file = create(&temporary).map_err(failed)?;
        Ok(Self { path, temporary, file: BufWriter::new(file), published: false })
    }

    fn failed(&self, action: &'static str) -> impl Fn(io::Error) -> FormatError + use<> {
        let path = self.path.to_owned();
        move |source| FormatError::Unwritable { path: path.clone(), action, source }
    }

    pub(super) fn write(&mut self, bytes: &[u8]) -> Result<(), FormatError> {
        let failed = self.failed("writing it");
        self.file.write_all(bytes).map_err(failed)
    }

    /// Flushes the bytes of this temporary file to the disk, and renames it to its final name, where it replaces an
    /// existing file. Then flushes the folder, so that the new name is still present after a power failure.
    pub(super) fn publish(mut self) -> Result<(), FormatError> {
        self.flush()?;
        fs::rename(&self.temporary, self.path).map_err(self.failed("renaming it"))?;
        self.published = true;
        sync_folder(self.path).map_err(self.failed("flushing it to the disk"))
    }

    /// Like [`Self::publish`], but returns false and does nothing if the file exists already.
    pub(super) fn publish_new(mut self) -> Result<bool, FormatError> {
        self.flush()?;
        match fs::hard_link(&self.temporary, self.path) {
            Ok(()) => sync_folder(self.path).map_err(self.failed("flushing it to the disk")).map(|()| true),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(false),
            // A file system without hard links.
            Err(_) if !self.path.exists() => self.publish().map(|()| true),
            Err(error) => Err(self.failed("creating it")(error)),
        }
    }

    /// Like [`Self::publish`], but replaces a file with the content `seen` only, and keeps its owner and permissions.
    /// Returns false and does nothing if the content is another one.
    pub(super) fn publish_over(mut self, seen: &[u8]) -> Result<bool, FormatError> {
        self.copy_access(self.path)?;
        self.flush()?;
        let is_seen = |path: &Path| {
            let has_length = fs::metadata(path).is_ok_and(|there| there.len() == seen.len() as u64);
            has_length && fs::read(path).is_ok_and(|content| content == seen)
        };
        let exchange = |draft: &Self| system::exchange(&draft.temporary, draft.path);
        if !is_seen(self.path) {
            return Ok(false);
        }
        if !exchange(&self).map_err(self.failed("replacing it"))? {
            return self.publish().map(|()| true);
        }
        // The file of before has the temporary name now, so a change of the last moment is still there.
        if is_seen(&self.temporary) {
            return sync_folder(self.path).map_err(self.failed("flushing it to the disk")).map(|()| true);
        }
        if let Err(error) = exchange(&self) {
            // The text of the other program stays under the temporary name.
            self.published = true;
            return Err(self.failed("restoring it")(error));
        }
        Ok(false)
    }

    /// Gives the temporary file the owner and the permissions of the file `like`.
    pub(super) fn copy_access(&self, like: &Path) -> Result<(), FormatError> {
        system::copy_access(like, self.file.get_ref()).map_err(self.failed("keeping its permissions"))
    }

    fn flush(&mut self) -> Result<(), FormatError> {
        let failed = self.failed("flushing it to the disk");
        self.file.flush().map_err(&failed)?;
        self.file.get_ref().sync_all().map_err(&failed)
    }
}

impl Drop for Draft<'_> {
    fn drop(&mut self) {
        if !self.published {
            // The first error is the one to report.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

/// Flushes the folder that contains `path` to the disk. After this, a file that was created or renamed there keeps its
/// name even after a power failure.
///
/// # Errors
/// A folder that cannot be flushed to the disk.
pub fn sync_folder(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    system::sync_folder(folder)
}
