//! Reading of a complete file of a structured format into memory, after its beginning was checked.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::error::FormatError;
use super::points::fill;
use super::system;
use regrind_core::geometry::Point;

/// Largest mesh file that is read, in bytes.
pub(super) const MAX_BYTES: u64 = 1 << 30;
/// Number of bytes that must be valid before the rest is read.
const HEAD: usize = 64 << 10;

/// Beginning of a file, with the open file for the rest.
pub(super) struct Opened {
    file: File,
    /// Length that the system reports; 0 for a pipe.
    pub(super) length: u64,
    /// First bytes, at most 64 KiB.
    pub(super) head: Vec<u8>,
}

/// Opens the file `path` and reads its first bytes, at most 64 KiB. Returns the open file, its length in bytes (0 for a
/// pipe), and these first bytes.
///
/// # Errors
/// A file that cannot be read.
pub(super) fn open(path: &Path) -> Result<Opened, FormatError> {
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    let mut file = system::open_to_read(path).map_err(unreadable)?;
    let length = file.metadata().map_err(unreadable)?.len();
    let mut head = vec![0; HEAD];
    let filled = fill(&mut file, &mut head).map_err(unreadable)?;
    head.truncate(filled);
    Ok(Opened { file, length, head })
}

/// Reads all bytes of a file.
///
/// # Errors
/// A file that cannot be read, or that has more than `limit` bytes.
pub fn read_whole(path: &Path, limit: u64) -> Result<Vec<u8>, FormatError> {
    open(path)?.read_all(path, limit)
}

impl Opened {
    /// Returns all bytes of this opened file, including the first bytes that are already read. `limit` is the maximum
    /// number of bytes. `path` only names the file in messages.
    ///
    /// # Errors
    /// A file that cannot be read, or that has more than `limit` bytes.
    pub(super) fn read_all(mut self, path: &Path, limit: u64) -> Result<Vec<u8>, FormatError> {
        let too_large = |found| FormatError::TooLarge { path: path.to_owned(), found, limit, unit: "bytes" };
        if self.length > limit {
            return Err(too_large(self.length));
        }
        let more = (limit + 1).saturating_sub(self.head.len() as u64);
        let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
        self.head.reserve((self.length as usize).saturating_sub(self.head.len()));
        (&mut self.file).take(more).read_to_end(&mut self.head).map_err(unreadable)?;
        let found = self.head.len() as u64;
        if found > limit { Err(too_large(found)) } else { Ok(self.head) }
    }

    /// Parses this opened file with the function `parse`, and returns the result of `parse`. `parse` gets `path` and
    /// the bytes of the file. `path` only names the file in messages.
    ///
    /// If at least 64 KiB were read, `parse` is first called with only the first 64 KiB. An error of this first call is
    /// returned at once, so that a large file of invalid content is not read to its end. One error is ignored: that the
    /// bytes end too early.
    ///
    /// # Errors
    /// The first error of `parse` that is not ignored; a file that cannot be read or is larger than 1 GiB.
    pub(super) fn parse<T>(
        self,
        path: &Path,
        parse: impl Fn(&Path, &[u8]) -> Result<T, FormatError>,
    ) -> Result<T, FormatError> {
        if self.head.len() == HEAD {
            match parse(path, &self.head) {
                Err(error) if !error.is_cut() => return Err(error),
                _ => {}
            }
        }
        parse(path, &self.read_all(path, MAX_BYTES)?)
    }
}

/// Returns true if the triangle with these corners has an area of 0.
pub(super) fn is_degenerate(corners: [&Point; 3]) -> bool {
    let [a, b, c] = corners;
    (b - a).cross(&(c - a)).norm_squared() == 0.0
}
