//! Reason why a command of a plant failed, and its exit code.

use std::io;
use std::path::PathBuf;

use regrind::journal::JournalError;
use regrind_live::LiveError;
use regrind_notify::NotifyError;
use regrind_plant::PlantError;
use thiserror::Error;

use super::super::outcome::{BAD_INPUT, FAULT, NOT_AS_IT_SHOULD_BE};

/// Reason why a command of a plant ended without a result.
#[derive(Debug, Error)]
pub(in super::super) enum PlantFailure {
    #[error("{reason}")]
    OpenWork { reason: String },
    #[error(
        "{}: this file cannot be read: {source}; check that the file exists, and that you have the right to read the file",
        .path.display()
    )]
    Unreadable { path: PathBuf, source: io::Error },
    #[error(transparent)]
    Plant(Box<PlantError>),
    #[error(transparent)]
    Live(#[from] LiveError),
    #[error(transparent)]
    Notify(Box<NotifyError>),
}

impl From<NotifyError> for PlantFailure {
    fn from(error: NotifyError) -> Self {
        Self::Notify(Box::new(error))
    }
}

impl From<PlantError> for PlantFailure {
    fn from(error: PlantError) -> Self {
        // Boxed because it is large and rare.
        Self::Plant(Box::new(error))
    }
}

impl PlantFailure {
    /// Returns the exit code of the program for this failure, as [`super::super::failure::Failure::exit_code`] does.
    pub(in super::super) fn exit_code(&self) -> u8 {
        match self {
            Self::OpenWork { .. } => NOT_AS_IT_SHOULD_BE,
            Self::Plant(error) if error.may_pass() => FAULT,
            Self::Plant(error)
                if matches!(
                    **error,
                    PlantError::Differs { .. }
                        | PlantError::UnsafeName { .. }
                        | PlantError::Journal(JournalError::Broken { .. } | JournalError::NoAuthor { .. })
                ) =>
            {
                NOT_AS_IT_SHOULD_BE
            }
            _ => BAD_INPUT,
        }
    }

    /// Returns true if the plant cannot be reached at the moment, so that a later try can succeed.
    pub(super) fn may_pass(&self) -> bool {
        matches!(self, Self::Plant(error) if error.may_pass())
    }
}
