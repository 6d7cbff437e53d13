//! Records of the loop, and the action that follows each record: the execution of a command, or the answer to a person.

use std::time::Duration;

use regrind_control::Reply;
use serde::Serialize;
use tokio::time::Instant;

use super::Drive;
use super::computation::create_folder;
use super::failure::failure_message;
use super::notice::Notice;
use super::outcome;
use super::record_queue::{PendingRecord, RecordAction, is_immediate, wait_for_first_record};
use super::recorder::{self, RecordReceipt, nanoseconds};
use super::station::StationRequest;
use crate::cell::{Command, Event, MachineRequest, RecordFailure};
use crate::formats::write_json_atomic;
use crate::journal::Artefact;
use crate::record::{self, CommandRecord, Content, EventDetail, EventRecord};

impl Drive {
    pub(super) fn record_event(&mut self, now: Duration, event: &Event, detail: Option<EventDetail>) -> RecordReceipt {
        let content = EventRecord { event: event.clone(), detail };
        let ticket = self.append(now, event.origin(), &Content::Event(Box::new(content)));
        // Record the outcome of each command that the event answers.
        let (answered, open): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.record.open_commands).into_iter().partition(|(_, c)| outcome::answers(event, c));
        self.record.open_commands = open;
        for (intent, _) in answered {
            let answer = Content::Answer(record::Answer::Event { event: event.name().to_owned() });
            let entry = answer.entry(nanoseconds(now), self.cell.cycle(), event.origin());
            let ticket = self.record.recorder.append_outcome(intent, entry);
            self.record.queue(ticket, RecordAction::Nothing);
        }
        ticket
    }

    /// Queues a command to be recorded, and executed after that. An immediate command ([`is_immediate`]) is only
    /// recorded here, because [`Self::handle_event`] has already executed it.
    pub(super) fn queue_command(&mut self, command: Command) {
        let content = Content::Command(Box::new(CommandRecord::new(command.clone(), self.machines.prepared)));
        let origin = ("cell".to_owned(), "regrind".to_owned());
        let ticket = if command.expects_answer() {
            let entry = content.entry(nanoseconds(self.now()), self.cell.cycle(), origin);
            let (intent, ticket) = self.record.recorder.append_intent(entry);
            self.record.open_commands.push((intent, command.clone()));
            ticket
        } else {
            self.append(self.now(), origin, &content)
        };
        let then =
            if is_immediate(&command) { RecordAction::Nothing } else { RecordAction::Execute(Box::new(command)) };
        self.record.queue(ticket, then);
    }

    /// Handles the oldest entry of the queue of entries that wait to be recorded, and removes it from this queue.
    /// `recorded` is the result of the attempt to record this entry.
    ///
    /// If the entry was recorded, does the action that waited for the record. This action is to execute a command, to
    /// answer an order, or to pass the confirmation of a person to the driver of a machine. A command is executed only
    /// if the cell still requires it.
    ///
    /// If the entry was not recorded, does not do this action, and reports the reason.
    pub(super) async fn handle_recorded(&mut self, recorded: Result<(), RecordFailure>) {
        let Some(PendingRecord { action: then, .. }) = self.record.backlog.pop_front() else { return };
        match recorded {
            Ok(()) => self.record.failure_reason = None,
            Err(why) => {
                let reason = failure_message(&why);
                match then {
                    RecordAction::Execute(command) => self.report_not_recorded(*command).await,
                    RecordAction::Answer { answer, message, .. } => {
                        let message = format!("{message}; not recorded: {reason}");
                        drop(answer.send(Reply::new(false, message, self.snapshot())));
                    }
                    RecordAction::Confirm { answer, .. } => drop(answer.send(Err(format!("not recorded: {reason}")))),
                    RecordAction::Nothing => {}
                }
                return self.report_record_failure(why).await;
            }
        }
        match then {
            RecordAction::Nothing => {}
            RecordAction::Execute(command) if self.cell.still_requires(&command) => self.execute(*command).await,
            RecordAction::Execute(command) => self.report_start_not_sent(*command).await,
            // The person who asked may be gone.
            RecordAction::Answer { answer, accepted, message } => {
                drop(answer.send(Reply::new(accepted, message, self.snapshot())))
            }
            RecordAction::Confirm { device, confirmation: word, answer } => {
                self.machines.send(device, StationRequest::Confirm { confirmation: word, answer }).await
            }
        }
    }

    /// Reports to the cell that a START was refused, because it was not sent. Either the START could not be recorded,
    /// or the cell changed its state before the record was written. Does nothing for other commands.
    pub(super) async fn report_start_not_sent(&mut self, command: Command) {
        if let Command::StartMachine { device, .. } = command {
            let reason = "START was not sent, because START could not be recorded, or because the cell was held before START was recorded".to_owned();
            self.handle_event(Event::Refused { device, request: MachineRequest::Start, reason }, None).await;
        }
    }

    /// Reports to the cell that `command` was not sent, because it could not be recorded. A START is always reported,
    /// as refused. Any other command is reported only if the cell still requires it and expects an answer to it.
    pub(super) async fn report_not_recorded(&mut self, command: Command) {
        if !self.cell.still_requires(&command) && !matches!(command, Command::StartMachine { .. }) {
            return;
        }
        match command {
            Command::StartMachine { .. } => self.report_start_not_sent(command).await,
            command if command.expects_answer() => {
                drop(self.handle_event(Event::NotOnRecord { command: command.name() }, None).await);
            }
            _ => {}
        }
    }

    /// Reports the failure `why` to write a record. Notifies people and the cell only of the first failure in a row.
    /// Then answers all orders that wait for their record.
    pub(super) async fn report_record_failure(&mut self, reason: RecordFailure) {
        let message = failure_message(&reason);
        let is_known = self.record.failure_reason.replace(message.clone()).is_some();
        // The consequences of a failure fail too, including the record of the failure itself. They bring nothing new.
        if !is_known {
            self.notify(Notice::RecordFailed { message });
            self.handle_event(Event::RecordFailed { reason }, None).await;
        }
        self.answer_unrecorded_orders();
    }

    /// Withdraws the commands that wait for their record and to which the cell expects an answer, and reports this to
    /// the cell. Otherwise the cell would wait for these answers until the disk works again. The cell issues a command
    /// again if it still needs it. Does nothing while records can be written, or after the end of the run.
    pub(super) async fn withdraw_pending_commands(&mut self) {
        if self.record.failure_reason.is_none() || self.ending.is_some() {
            return;
        }
        let leads_on = |then: &RecordAction| matches!(then, RecordAction::Execute(command) if command.expects_answer());
        let waiting = self.record.backlog.iter_mut().filter(|waiting| leads_on(&waiting.action));
        let withdrawn: Vec<RecordAction> =
            waiting.map(|waiting| std::mem::replace(&mut waiting.action, RecordAction::Nothing)).collect();
        for then in withdrawn {
            if let RecordAction::Execute(command) = then {
                self.report_not_recorded(*command).await;
            }
        }
    }

    /// Answers all orders that wait for their record with a refusal, so that no client waits for long. The message
    /// states that only steps to make the cell safe were carried out, and why the order was not recorded. Does nothing
    /// while records can be written.
    pub(super) fn answer_unrecorded_orders(&mut self) {
        let Some(reason) = &self.record.failure_reason else { return };
        let status = self.snapshot();
        for waiting in &mut self.record.backlog {
            match std::mem::replace(&mut waiting.action, RecordAction::Nothing) {
                RecordAction::Answer { answer, message, .. } => {
                    let message = format!(
                        "{message}; only the steps that make the cell safe were carried out, because the order was not recorded: {reason}"
                    );
                    // The person who asked may be gone.
                    drop(answer.send(Reply::new(false, message, status.clone())));
                }
                then => waiting.action = then,
            }
        }
    }

    /// Adds files of a cycle to the record. If `files` is an error, reports that they could not be written.
    pub(super) async fn record_files(&mut self, cycle: u32, files: Result<Vec<Artefact>, RecordFailure>) {
        match files {
            Ok(files) if files.is_empty() => {}
            Ok(files) => {
                let bytes = self.computations.cycle_bytes.entry(cycle).or_insert(0);
                *bytes += files.iter().map(|file| file.bytes).sum::<u64>();
                self.computations.max_cycle_bytes = self.computations.max_cycle_bytes.max(*bytes);
                let ticket = self.record.recorder.append_artefacts(files, self.now(), cycle);
                self.record.queue(ticket, RecordAction::Nothing);
            }
            // A failure to write the loop's own final files is only shown, because the run is over.
            Err(reason) if self.ending.is_some() => {
                self.notify(Notice::RecordFailed { message: failure_message(&reason) })
            }
            Err(reason) => Box::pin(self.report_record_failure(reason)).await,
        }
    }

    /// Writes `document` as JSON to the file `name`, relative to the run folder, and records the file. If it cannot be
    /// written, only notifies people.
    pub(super) async fn write_document(&mut self, name: String, cycle: u32, document: &impl Serialize) {
        let path = self.context.folder.join(&name);
        let made = create_folder(path.parent().unwrap_or(&self.context.folder));
        match made.and_then(|()| write_json_atomic(path, document)) {
            Ok(()) => self.record_files(cycle, recorder::sync_and_hash(&self.context.folder, &[name])).await,
            Err(error) => self.notify(Notice::RecordFailed { message: error.to_string() }),
        }
    }

    /// Queues a record of what the machine `actor` reported besides events.
    pub(super) fn record_note(&mut self, actor: &str, content: &Content) {
        let ticket = self.append(self.now(), (actor.to_owned(), "wire".to_owned()), content);
        self.record.queue(ticket, RecordAction::Nothing);
    }

    /// Queues a record with `content`. `now` is the time since the run began. `origin` is the person or machine that
    /// caused the content, and its place.
    pub(super) fn append(&self, now: Duration, origin: (String, String), content: &Content) -> RecordReceipt {
        self.record.recorder.append(content.entry(nanoseconds(now), self.cell.cycle(), origin))
    }

    /// Waits after the end of the run until all queued entries are recorded. In this time, still writes judgements and
    /// answers orders, but executes no other command. Gives up after [`recorder::CLOSE_TIMEOUT`], and then answers the
    /// remaining orders with the reason.
    pub(super) async fn finish_backlog(&mut self) {
        let by = Instant::now() + recorder::CLOSE_TIMEOUT;
        while !self.record.backlog.is_empty() {
            let recorded = tokio::select! {
                biased;
                recorded = wait_for_first_record(&mut self.record.backlog) => recorded,
                reason = self.record.recorder.next_failure() => {
                    self.record.failure_reason = Some(failure_message(&reason));
                    self.answer_unrecorded_orders();
                    continue;
                }
                () = tokio::time::sleep_until(by) => {
                    self.record.failure_reason.get_or_insert_with(|| "the disk does not answer".to_owned());
                    return self.answer_unrecorded_orders();
                }
            };
            match self.record.backlog.front().map(|next| &next.action) {
                Some(RecordAction::Execute(command)) if matches!(**command, Command::Announce(_)) => {
                    self.handle_recorded(recorded).await
                }
                Some(RecordAction::Answer { .. }) => self.handle_recorded(recorded).await,
                _ => drop(self.record.backlog.pop_front()),
            }
        }
    }
}
