//! Orders of people: events for the cell, confirmations for a machine, and remarks for the record.

use data_encoding::HEXLOWER;
use regrind_control::{ReceivedOrder, Reply, Request};
use tokio::sync::oneshot;

use super::Drive;
use super::machine_monitor::MachineMonitor;
use super::record_queue::RecordAction;
use crate::cell::{Actor, AlarmId, Device, Event, Phase};
use crate::device::{Identified, OperatorConfirmation};
use crate::record::{Confirmation, Content, Remark};

impl Drive {
    /// Handles the order `request` of `actor`. Most orders go to the cell as events. A remark is only recorded, and a
    /// confirmation about a machine goes to the driver of this machine. Sends the reply through `answer`, if there is
    /// one, after the order is recorded.
    ///
    /// Refuses a resume, and the reason of a hold, if the state of the cell has changed since the person saw it. Does nothing for the requests
    /// `Status` and `Watch`.
    pub(super) async fn handle_order(&mut self, ReceivedOrder { request, actor, answer }: ReceivedOrder) {
        if let Request::Resume { state_number: Some(seen), .. } | Request::Hold { state_number: Some(seen), .. } =
            request
            && seen != self.display.state_changes
        {
            let message = format!(
                "the state of the cell changed before your order arrived; the state is now {}; check this state, then give the order again",
                self.cell.in_words()
            );
            // The person who asked may be gone.
            if let Some(answer) = answer {
                drop(answer.send(Reply::new(false, message, self.snapshot())));
            }
            return;
        }
        let event = match request {
            Request::Started { .. } | Request::Done { .. } | Request::Still { .. } => {
                return self.handle_confirmation(&request, &actor, answer);
            }
            Request::Remark { what, alarm } => return self.record_remark((what, alarm), &actor, answer),
            Request::Clear { device } => Event::ClearConfirmed { actor, device },
            Request::Hold { reason, .. } => Event::Hold { actor, reason },
            Request::Resume { reason, .. } => Event::Resume { actor, reason },
            Request::Stop { reason } => Event::Stop { actor, reason },
            Request::Abort { reason } => Event::Abort { actor, reason },
            Request::Loaded => Event::LoadConfirmed { actor },
            Request::Over { device, evidence } => Event::DeclaredOver { actor, device, evidence },
            Request::Touches { from } => {
                let touches = Some(self.display.preview_statistics.touches_from(from));
                if let Some(answer) = answer {
                    drop(answer.send(Reply { touches, ..Reply::new(true, String::new(), self.snapshot()) }));
                }
                return;
            }
            Request::Machines => {
                let machines = Some(self.machines.monitors.each_ref().map(MachineMonitor::status));
                if let Some(answer) = answer {
                    drop(answer.send(Reply { machines, ..Reply::new(true, String::new(), self.snapshot()) }));
                }
                return;
            }
            Request::Status | Request::Watch => return,
        };
        let (refusal, ticket) = self.handle_event(event, None).await;
        if let Some(answer) = answer {
            let accepted = refusal.is_none();
            let message = refusal.unwrap_or_else(|| self.cell.in_words());
            self.record.queue(ticket, RecordAction::Answer { answer, accepted, message });
            self.answer_unrecorded_orders();
        }
    }

    /// Records the text and the acknowledged alarm of a [`Request::Remark`]. Answers the program that sent the request
    /// through `answer`, after the remark is recorded. Refuses a remark without content, and the acknowledgement of an
    /// alarm that is not active.
    pub(super) fn record_remark(
        &mut self,
        (remark, alarm): (String, Option<AlarmId>),
        actor: &Actor,
        answer: Option<oneshot::Sender<Reply>>,
    ) {
        let status = self.snapshot();
        let refusal = match alarm {
            Some(id) if !status.alarms.iter().any(|active| active.id == id) => Some("this alarm is not active"),
            None if remark.trim().is_empty() => Some("the entry has no text"),
            _ => None,
        };
        if let Some(refusal) = refusal {
            if let Some(answer) = answer {
                drop(answer.send(Reply::new(false, refusal.to_owned(), status)));
            }
            return;
        }
        let ticket = self.append(self.now(), origin(actor), &Content::Remark(Remark { remark, alarm }));
        if let Some(answer) = answer {
            let then = RecordAction::Answer { answer, accepted: true, message: "recorded".into() };
            self.record.queue(ticket, then);
            self.answer_unrecorded_orders();
        }
    }

    /// Records the confirmation of a person about a machine that cannot report its own state, and then passes it to the
    /// driver of this machine. Sends the result through `answer`, if there is one. The reply is a refusal if the
    /// confirmation does not fit the run, cannot be recorded, or is refused by the driver.
    pub(super) fn handle_confirmation(
        &mut self,
        request: &Request,
        actor: &Actor,
        answer: Option<oneshot::Sender<Reply>>,
    ) {
        let asked = self.operator_confirmation(request).map(|(confirmed, word)| {
            let (device, ..) = confirmed.parts();
            let ticket = self.append(self.now(), origin(actor), &Content::Confirmation(confirmed));
            let (told, taken) = oneshot::channel();
            self.record.queue(ticket, RecordAction::Confirm { device, confirmation: word, answer: told });
            taken
        });
        let status = self.snapshot();
        // The station answers in its turn; the loop does not wait for it.
        tokio::spawn(async move {
            let told = match asked {
                Ok(taken) => taken.await.unwrap_or_else(|_| Err("the run is over".into())),
                Err(reason) => Err(reason),
            };
            let message = told.as_ref().err().unwrap_or(&status.message).clone();
            let reply = Reply::new(told.is_ok(), message, status);
            if let Some(answer) = answer {
                let _ = answer.send(reply);
            }
        });
    }

    /// Converts the confirmation of a person (started, done, or at rest) into a confirmation for the driver of a
    /// machine. Returns the confirmation for the record, and the confirmation for the driver.
    ///
    /// # Errors
    /// Returns a message for the person:
    ///
    /// - For "started" and "done": no job is in progress, or the person gave digits that are not the first digits of
    ///   the SHA-256 of the correction map.
    /// - For "at rest": the person names no machine, and no job is in progress.
    /// - For every other request: it is not a confirmation.
    pub(super) fn operator_confirmation(
        &self,
        request: &Request,
    ) -> Result<(Confirmation, OperatorConfirmation), String> {
        let at_work = self.cell.state().phase().and_then(Phase::moving_device);
        let job = || at_work.ok_or("no machine has a job in progress, so there is no job to confirm");
        let identity = |map: &Option<String>| map.as_ref().map(|digits| self.map_identity(digits)).transpose();
        Ok(match request {
            Request::Started { map } => (
                Confirmation::Started { device: job()?, map: map.clone() },
                OperatorConfirmation::Started { map_identity: identity(map)? },
            ),
            Request::Done { map, file } => {
                let recorded = file.as_ref().map(|file| file.to_string_lossy().into_owned());
                (
                    Confirmation::Done { device: job()?, map: map.clone(), file: recorded },
                    OperatorConfirmation::Done { map_identity: identity(map)?, file: file.clone() },
                )
            }
            Request::Still { device } => {
                let device =
                    device.or(at_work).ok_or("name the machine that is at rest: --machine cmm or --machine grinder")?;
                (Confirmation::Still { device }, OperatorConfirmation::Still)
            }
            _ => return Err("this order is not a confirmation for a machine".into()),
        })
    }

    /// Returns the SHA-256 of the correction map of the pass in progress. `digits` are at least the first 8 hexadecimal
    /// digits of this hash, as a person reads them at the grinder. Returns an error if `digits` are fewer than 8 or
    /// differ from the hash, or if no pass is in progress.
    pub(super) fn map_identity(&self, digits: &str) -> Result<[u8; 32], String> {
        let digits = digits.trim().to_lowercase();
        let grinds = self.cell.state().phase().and_then(Phase::moving_device) == Some(Device::Grinder);
        let cycle = self.cycles.get(self.cell.cycle()).filter(|_| grinds);
        let Some(cycle) = cycle else { return Err("no pass is in progress".into()) };
        let identity = self.task.payloads(&cycle.correction).0.identity();
        let whole = HEXLOWER.encode(&identity);
        if digits.len() < 8 {
            return Err(
                "give at least the first 8 digits of the map identity; the file correction.csv has this identity"
                    .into(),
            );
        }
        if !whole.starts_with(&digits) {
            let (given, handed) = (digits.get(..8).unwrap_or(&digits), &whole[..8]);
            return Err(format!(
                "map {handed} was sent, but the confirmation names map {given}; check which map is set up at the grinder"
            ));
        }
        Ok(identity)
    }
}

/// Returns the name of a person and the place of the person, as a record has them.
fn origin(actor: &Actor) -> (String, String) {
    (actor.name.clone(), actor.station.clone())
}
