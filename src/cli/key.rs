//! `regrind audit key`: shows and creates the key of this computer, and exports the public key for quality assurance.

use std::env;
use std::io;
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::journal::{AuditKey, JournalError, PublicKey};
use serde_json::json;

use super::Outcome;
use super::failure::Failure;
use super::outside::settings_folder;

/// Environment variable with the file of the key. If empty, no key is used.
const KEY: &str = "REGRIND_KEY";

/// Create the key that signs the records of this computer, if it does not exist, and print its public half
#[derive(Args, Debug)]
#[command(after_help = "\
The variable REGRIND_KEY names the file of the key. Without this variable, the file is
$XDG_CONFIG_HOME/regrind/audit.key or ~/.config/regrind/audit.key (on Windows in %LOCALAPPDATA%). Only the owner of the
file can read the key. If the key exists, the command keeps the key and prints its public half. All later runs of this
user sign their records with this key.

Examples:
  regrind audit key
  regrind audit key --json > /mnt/quality/grinding-cell-2.key
  regrind audit verify --key /mnt/quality/grinding-cell-2.key

Exit codes: 0 printed; 2 the file cannot be created or read, other users can read the file, or the file has no key.")]
pub(super) struct Arguments {
    /// File of the key
    #[arg(long, value_name = "FILE")]
    key: Option<PathBuf>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let named = || Place::of_this_user().file().ok_or(Failure::NoPlaceForKey);
    let path = arguments.key.clone().map_or_else(named, Ok)?;
    let (key, made) = made_or_read(&path).map_err(Failure::Journal)?;
    let public = key.public();
    if arguments.json {
        let fingerprint = public.fingerprint();
        super::print_json(&json!({ "public_key": public, "fingerprint": fingerprint, "file": path, "made": made }))?;
    } else {
        super::print(&in_words(&public, &path, made))?;
    }
    Ok(Outcome::Accepted)
}

fn made_or_read(path: &Path) -> Result<(AuditKey, bool), JournalError> {
    if path.exists() {
        return Ok((AuditKey::read(path)?, false));
    }
    match AuditKey::make(path) {
        Ok(key) => Ok((key, true)),
        // Another process can have created it at the same moment.
        Err(JournalError::File { source, .. }) if source.kind() == io::ErrorKind::AlreadyExists => {
            Ok((AuditKey::read(path)?, false))
        }
        Err(error) => Err(error),
    }
}

fn in_words(public: &PublicKey, path: &Path, made: bool) -> String {
    let made = if made { "created now" } else { "existed already" };
    let fingerprint = public.fingerprint();
    format!(
        "public key   {public}\nfingerprint  {fingerprint}\nfile         {}, {made}\n\n\
         Runs of this user sign their records with this key from now on. Keep the public key where nobody at this computer can change it:\n\
         give it to the quality department, which verifies records with `regrind audit verify --key`. Keep the key file on this\n\
         computer. Other persons must not be able to read the file or a copy of the file.\n\
         If the key file is lost, no record is lost, but later runs need another key.\n",
        path.display()
    )
}

/// Location of the key file of a user.
enum Place {
    /// File that REGRIND_KEY names; it must exist.
    Named(PathBuf),
    /// REGRIND_KEY is empty: no key is used.
    Nowhere,
    /// File in the folder of the user's settings; it is optional. `None` if there is no such folder.
    Usual(Option<PathBuf>),
}

impl Place {
    fn of_this_user() -> Self {
        match env::var_os(KEY) {
            Some(named) if named.is_empty() => Self::Nowhere,
            Some(named) => Self::Named(named.into()),
            None => Self::Usual(settings_folder().map(|settings| settings.join("regrind").join("audit.key"))),
        }
    }

    fn file(self) -> Option<PathBuf> {
        match self {
            Self::Named(path) | Self::Usual(Some(path)) => Some(path),
            Self::Nowhere | Self::Usual(None) => None,
        }
    }
}

/// Reads the key that signs the runs of this user. Returns `None` if the user has no key, and an error if the key file
/// cannot be read.
pub(super) fn of_this_user() -> Result<Option<AuditKey>, Failure> {
    let path = match Place::of_this_user() {
        Place::Usual(Some(path)) if path.exists() => path,
        Place::Named(path) => path,
        Place::Usual(_) | Place::Nowhere => return Ok(None),
    };
    AuditKey::read(&path).map(Some).map_err(Failure::Journal)
}

/// Parses a public key from the command-line argument `word`. The argument is the key as 64 lower-case hexadecimal
/// digits, or the path of a file with the output of `regrind audit key`. Returns the reason if `word` is neither of
/// them.
pub(super) fn public(word: &str) -> Result<PublicKey, String> {
    if let Ok(key) = word.parse() {
        return Ok(key);
    }
    let text = std::fs::read_to_string(word).map_err(|error| {
        format!("the value is neither 64 lower-case hexadecimal digits nor a readable file ({error}); give the output of `regrind audit key`")
    })?;
    PublicKey::from_text(&text)
        .map_err(|()| "the file contains no public key; give the output of `regrind audit key`".to_owned())
}
