//! Check of the receivers of notifications by `regrind doctor`.

use std::path::PathBuf;

use clap::Args;
use regrind_notify::Receiver;

use super::super::failure::Failure;
use super::plant_file::read;

/// Plant whose receivers are tried.
#[derive(Args, Debug)]
pub(in super::super) struct DoctorArguments {
    /// Also try the receivers of notifications of this plant file, without a notification
    #[arg(long, value_name = "FILE")]
    plant: Option<PathBuf>,
}

impl DoctorArguments {
    /// Tries each receiver of notifications of the plant file: connects to it, and signs in to a mail server. Sends no
    /// notification. Returns the name of each with its result in words.
    ///
    /// Returns an error if the plant file is invalid or a file of a receiver cannot be read.
    pub(in super::super) async fn try_receivers(&self) -> Result<Vec<(String, Result<String, String>)>, Failure> {
        let Some(plant) = &self.plant else { return Ok(Vec::new()) };
        let config = read(plant)?;
        let receivers = config.notify.as_ref().map(Receiver::all).transpose()?.unwrap_or_default();
        let mut found = Vec::new();
        for receiver in receivers {
            let place = receiver.place();
            let tried = receiver.try_server().await;
            let words = tried
                .map(|()| format!("{place} answers"))
                .map_err(|reason| format!("{place} cannot be used: {reason}; runs continue without it"));
            found.push((format!("notifications to {}", receiver.name()), words));
        }
        Ok(found)
    }
}
