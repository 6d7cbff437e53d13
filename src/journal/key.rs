//! The key with which a computer signs the head of its records, and the public key with which others verify the
//! signatures.

use std::fmt::{self, Debug, Display, Formatter};
use std::fs;
use std::io::{self, Write};
use std::path::Path;
use std::str::FromStr;

use data_encoding::HEXLOWER;
use ed25519_compact::{KeyPair, Seed, Signature};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use sha2::{Digest, Sha256};

use super::canonical::unhex;
use super::error::JournalError;
use super::open::sync_folder;
use super::system;

/// First line of the key file; explains the file to a person who finds it.
const FIRST_LINE: &str =
    "# Audit key of Regrind (Ed25519). Secret: who has this file can sign records in this computer's name.";
/// Maximum length of a key file, in bytes.
const MAX_BYTES: u64 = 4096;

/// Public half of an audit key. A record names it, and the quality department keeps it. Displayed as 64 lowercase
/// hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PublicKey([u8; 32]);

impl PublicKey {
    /// Returns the fingerprint of the key, which two people can compare: the first 16 hexadecimal digits of the SHA-256
    /// of the key, in groups of four.
    pub fn fingerprint(&self) -> String {
        let digits = HEXLOWER.encode(&Sha256::digest(self.0)[..8]);
        (0..4).map(|k| &digits[4 * k..4 * k + 4]).collect::<Vec<_>>().join(" ")
    }

    /// Returns true if `signature` is the Ed25519 signature (RFC 8032) of `message`, made with the secret key that
    /// belongs to this public key. `signature` must have 128 lowercase hexadecimal digits. Returns false for any other
    /// text.
    pub fn has_signed(&self, message: &[u8], signature: &str) -> bool {
        let Some(signature) = unhex::<64>(signature).map(Signature::new) else { return false };
        ed25519_compact::PublicKey::new(self.0).verify(message, &signature).is_ok()
    }

    /// Parses a public key: 64 hexadecimal digits, or the output of `regrind audit key`, with or without `--json`.
    ///
    /// # Errors
    /// The text contains no public key.
    #[expect(clippy::result_unit_err, reason = "there is one way to be none")]
    pub fn from_text(text: &str) -> Result<Self, ()> {
        let text = text.trim();
        let of_line =
            |line: &str| line.strip_prefix("public")?.split_whitespace().next_back()?.trim_matches('"').parse().ok();
        if let Ok(value) = serde_json::from_str::<serde_json::Value>(text) {
            return value["public_key"].as_str().ok_or(())?.parse();
        }
        text.parse().or_else(|()| text.lines().find_map(of_line).ok_or(()))
    }
}

impl Display for PublicKey {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(&HEXLOWER.encode(&self.0))
    }
}

impl Debug for PublicKey {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "PublicKey({self})")
    }
}

impl FromStr for PublicKey {
    type Err = ();

    fn from_str(digits: &str) -> Result<Self, ()> {
        unhex(digits).map(Self).ok_or(())
    }
}

impl<'de> Deserialize<'de> for PublicKey {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(|()| D::Error::custom("not a public key"))
    }
}

impl Serialize for PublicKey {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Key pair of a computer: the secret and the public half.
#[derive(Clone)]
pub struct AuditKey {
    pair: KeyPair,
}

impl Debug for AuditKey {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        // The secret half must not appear in a log.
        write!(f, "AuditKey({})", self.public())
    }
}

impl AuditKey {
    /// Creates a new key from random numbers of the operating system.
    pub fn new() -> Self {
        Self::from_seed(rand::random())
    }

    fn from_seed(seed: [u8; 32]) -> Self {
        Self { pair: KeyPair::from_seed(Seed::new(seed)) }
    }

    /// Returns the public key that belongs to this key.
    pub fn public(&self) -> PublicKey {
        PublicKey(*self.pair.pk)
    }

    /// Returns the Ed25519 signature of `message` as 128 hexadecimal digits. The same message always gives the same
    /// signature.
    ///
    /// The first line of `message` must state the purpose of the message. A signature for one purpose is then not valid
    /// for another purpose.
    pub fn sign(&self, message: &[u8]) -> String {
        HEXLOWER.encode(self.pair.sk.sign(message, None).as_ref())
    }

    /// Reads the key from its file.
    ///
    /// # Errors
    /// The file does not exist; other users can read the file, or replace it in its folder; it contains no valid key.
    pub fn read(path: &Path) -> Result<Self, JournalError> {
        let failed = JournalError::file(path, "reading it");
        let broken = |what| JournalError::Key { path: path.to_owned(), what };
        let found = fs::metadata(path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => broken("the file does not exist"),
            _ => failed(error),
        })?;
        if !found.is_file() || found.len() > MAX_BYTES {
            return Err(broken("it is not a small file"));
        }
        if let Some(system::OpenToOthers { how, remedy }) = system::readable_by_others(path).map_err(&failed)? {
            return Err(JournalError::KeyIsOpen { path: path.to_owned(), how, remedy });
        }
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        if let Some(system::OpenToOthers { how, remedy }) = system::changeable_by_others(folder).map_err(&failed)? {
            return Err(JournalError::KeyIsOpen { path: path.to_owned(), how, remedy });
        }
        let text = String::from_utf8(fs::read(path).map_err(&failed)?).map_err(|_| broken("it is not text"))?;
        let value = |name: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(name)?.trim_start().strip_prefix('='))?;
            unhex::<32>(line.trim().trim_matches('"'))
        };
        let seed = value("secret").ok_or_else(|| broken("its line `secret = \"...\"` has no 64 hexadecimal digits"))?;
        let key = Self::from_seed(seed);
        match value("public") {
            Some(public) if public == key.public().0 => Ok(key),
            _ => Err(broken("its line `public` does not match its line `secret`")),
        }
    }

    /// Creates a new key, and writes it to the file `path`, which only the owner can read. Creates the folder of the
    /// file if it does not exist.
    ///
    /// # Errors
    /// A file of that name exists, and stays unchanged; the folder cannot be written; the disk is full.
    pub fn make(path: &Path) -> Result<Self, JournalError> {
        let key = Self::new();
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        system::create_owners_folder(folder).map_err(JournalError::file(folder, "creating the folder"))?;
        let temporary = folder.join(format!(".audit-key-{:016x}.tmp", rand::random::<u64>()));
        // A hard link, not a rename: a rename would replace an existing key.
        let written = key.write(&temporary).and_then(|()| fs::hard_link(&temporary, path));
        // Report the first error, not that of the cleanup.
        let _ = fs::remove_file(&temporary);
        written.map_err(JournalError::file(path, "creating it"))?;
        sync_folder(folder)?;
        Ok(key)
    }

    fn write(&self, path: &Path) -> io::Result<()> {
        let mut file = system::create_owners_file(path)?;
        let secret = HEXLOWER.encode(self.pair.sk.seed().as_ref());
        write!(file, "{FIRST_LINE}\nsecret = \"{secret}\"\npublic = \"{}\"\n", self.public())?;
        file.sync_all()
    }
}

impl Default for AuditKey {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_match_rfc_8032() {
        // RFC 8032, section 7.1, test 2.
        let seed = unhex("4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb").unwrap();
        let key = AuditKey::from_seed(seed);
        assert_eq!(key.public().to_string(), "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c");
        let signature = "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da\
                         085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00";
        assert_eq!(key.sign(&[0x72]), signature);
        assert!(key.public().has_signed(&[0x72], signature));
        assert!(!key.public().has_signed(&[0x73], signature) && !key.public().has_signed(&[0x72], &signature[2..]));
    }
}
