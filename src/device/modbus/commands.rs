//! Commands of the handshake, from CLAIM to RELEASE: each is written until the machine acknowledges it.

use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::machine::ModbusMachine;
use super::protocol::CommandFrame;
use super::status_block::StatusBlock;
use crate::{Answer, Armed, DeviceError, Fault, Job, MachineCommand, MachineState, Reconciled, Started, digest};

/// Time for a machine to acknowledge a command before the same frame is written again.
pub(super) const ACKNOWLEDGE_TIMEOUT: Duration = Duration::from_millis(500);
/// Time for a machine to process a payload, or to reach the announced state.
pub(super) const SETTLE_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum time for which the status must show that a start was not accepted, before this is reported.
const NOT_STARTED_CONFIRMATION: Duration = Duration::from_millis(1050);

impl ModbusMachine {
    pub(super) async fn claim(&mut self) -> Result<StatusBlock, DeviceError> {
        let status = self.run_command(MachineCommand::Claim).await?;
        self.owned = true;
        Ok(status)
    }

    pub(super) async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
        let identities: Vec<_> = self.loaded.values().map(|slot| slot.identity).collect();
        let loaded = digest(&identities);
        if identities.is_empty() || loaded != job.digest {
            let machine = self.machine();
            return Err(DeviceError::Mismatch {
                machine,
                field: "the digest of the payloads",
                sent: job.digest.into(),
                found: loaded.into(),
            });
        }
        for kind in self.loaded.keys().copied().collect::<Vec<_>>() {
            self.compare_slot(kind).await?;
        }
        let frame = CommandFrame { job: Some(job), ..self.frame(MachineCommand::Prepare) };
        self.send_command(frame).await?;
        let status = self.wait_until(|status| status.state == MachineState::Prepared && status.token != 0).await?;
        self.check_job(job, &status)?;
        Ok(Armed { job, start_sequence: self.next_sequence(), token: status.token, boot_id: status.boot_id })
    }

    pub(super) async fn start(&mut self, armed: Armed) -> Result<Started, DeviceError> {
        let Armed { job, start_sequence, token, boot_id } = armed;
        let known = self.unit.identity().map_or(0, |identity| identity.boot_id);
        if boot_id != known {
            // Nothing was sent: the restart of the machine has discarded the prepared job.
            return Err(DeviceError::Restarted { machine: self.machine(), old_boot_id: boot_id, new_boot_id: known });
        }
        // Nothing was sent yet, so an error here is only a failed read. A prepared job that has expired since is a
        // clear refusal.
        let before = self.read_status_block().await?;
        let taken = before.begun_by == start_sequence || before.acknowledged == start_sequence;
        if !taken && (before.state != MachineState::Prepared || before.token != token) {
            let (command, answer, state) = (MachineCommand::Start, Answer::DeadToken, before.state);
            return Err(DeviceError::Refused { machine: self.machine(), command, answer, state });
        }
        self.last_start = Some(start_sequence);
        self.read_ahead = None;
        let (owner, epoch) = (self.owner, self.epoch);
        let frame = CommandFrame {
            sequence: start_sequence,
            command: MachineCommand::Start,
            job: Some(job),
            owner,
            epoch,
            token,
            argument: 0,
        };
        let unknown = |machine, reason| DeviceError::StartUnknown {
            machine,
            job,
            sequence: start_sequence,
            cause: Box::new(reason),
        };
        match self.send_command(frame).await {
            Ok(status) if status.begun_by == start_sequence && status.job == Some(job) => {
                Ok(Started { job, start_sequence, status: status.into() })
            }
            Ok(status) => {
                let (sent, held) = (u64::from(start_sequence), u64::from(status.begun_by));
                let (machine, field) = (self.machine(), "the START that began the job");
                Err(unknown(self.machine(), DeviceError::Mismatch { machine, field, sent, found: held }))
            }
            // The machine has answered this very START and refused it.
            Err(refused @ DeviceError::Refused { .. }) => Err(refused),
            Err(DeviceError::NotConnected { machine, operation: what }) => {
                Err(DeviceError::NotConnected { machine, operation: what })
            }
            Err(reason) => Err(unknown(self.machine(), reason)),
        }
    }

    pub(super) async fn reconcile(&mut self, intended: &Armed) -> Result<Reconciled, DeviceError> {
        self.last_start = Some(intended.start_sequence);
        let first = self.read_status_block().await?;
        match start_outcome(intended, &first) {
            Some(verdict) => return Ok(verdict),
            None => {
                let began = Instant::now();
                while began.elapsed() < NOT_STARTED_CONFIRMATION {
                    sleep(self.heartbeat_interval).await;
                    self.send_heartbeat().await?;
                }
            }
        }
        // A START may still be under way in the network. Once the machine has acknowledged a higher number, it no
        // longer accepts this START.
        self.sequence = self.sequence.max(intended.start_sequence).max(first.acknowledged);
        self.claim().await?;
        let second = self.read_status_block().await?;
        Ok(start_outcome(intended, &second).unwrap_or(Reconciled::NotStarted(second.into())))
    }

    /// Commands the machine to end the job at once. Returns the status that acknowledges this command. If the
    /// connection is lost, opens it at once, without the pause that usually follows an error.
    ///
    /// If the machine does not acknowledge the command, another client may have used higher sequence numbers. This
    /// function then reads the status. If the state is ABORTING or ABORTED, returns this status. Otherwise sends the
    /// abort again with a number above the last acknowledged number.
    ///
    /// # Errors
    /// Returns an error if the connection cannot be opened, if a request fails, or if the machine refuses or does not
    /// acknowledge the command.
    pub(super) async fn abort(&mut self) -> Result<StatusBlock, DeviceError> {
        self.unit.link.skip_pause();
        if self.unit.identity().is_none() {
            self.unit.connect_within(Duration::ZERO).await?;
        }
        match self.run_command(MachineCommand::Abort).await {
            // Another client has used higher numbers. The state of the machine decides; if it does not abort, an abort
            // justifies a number above theirs.
            Err(DeviceError::NotAcknowledged { acknowledged, .. }) => match self.read_status_block().await? {
                status if matches!(status.state, MachineState::Aborting | MachineState::Aborted) => Ok(status),
                _ => {
                    self.sequence = self.sequence.max(acknowledged);
                    self.run_command(MachineCommand::Abort).await
                }
            },
            answer => answer,
        }
    }

    pub(super) async fn acknowledge(&mut self, done: u32) -> Result<StatusBlock, DeviceError> {
        let frame = CommandFrame { argument: done, ..self.frame(MachineCommand::Acknowledge) };
        self.send_command(frame).await
    }

    pub(super) async fn release(&mut self) -> Result<StatusBlock, DeviceError> {
        self.owned = false;
        self.run_command(MachineCommand::Release).await
    }

    pub(super) async fn run_command(&mut self, command: MachineCommand) -> Result<StatusBlock, DeviceError> {
        let frame = self.frame(command);
        self.send_command(frame).await
    }

    /// Writes the command `frame` and waits until the machine acknowledges it. If no acknowledgement arrives within
    /// [`ACKNOWLEDGE_TIMEOUT`], writes the same frame again, at most `retries` times. Returns the status that
    /// acknowledges the command.
    ///
    /// # Errors
    /// The machine refuses the command or does not acknowledge it, or a request fails.
    async fn send_command(&mut self, frame: CommandFrame) -> Result<StatusBlock, DeviceError> {
        let CommandFrame { command, sequence, .. } = frame;
        let status = self.write_until_acknowledged(frame).await?;
        self.sequence = self.sequence.max(sequence);
        match status.answer {
            Answer::Accepted => Ok(status),
            answer => Err(DeviceError::Refused { machine: self.machine(), command, answer, state: status.state }),
        }
    }

    async fn write_until_acknowledged(&mut self, frame: CommandFrame) -> Result<StatusBlock, DeviceError> {
        let CommandFrame { command, sequence, .. } = frame;
        let words = frame.words(self.unit.map.word_order);
        let address = self.unit.map.command;
        let mut tries = 0;
        loop {
            self.unit.write("command", address, &words).await?;
            tries += 1;
            let written = Instant::now();
            let mut pause = Duration::from_millis(1);
            let last = loop {
                let status = self.read_status_block().await?;
                if status.acknowledged == sequence {
                    return Ok(status);
                }
                if written.elapsed() >= ACKNOWLEDGE_TIMEOUT {
                    break status.acknowledged;
                }
                sleep(pause).await;
                pause = (pause * 2).min(Duration::from_millis(20));
            };
            if tries > self.retries {
                let machine = self.machine();
                return Err(DeviceError::NotAcknowledged { machine, command, sequence, acknowledged: last, tries });
            }
        }
    }

    fn next_sequence(&mut self) -> u32 {
        self.sequence = self.sequence.checked_add(1).unwrap_or(1);
        self.sequence
    }

    pub(super) fn frame(&mut self, command: MachineCommand) -> CommandFrame {
        let sequence = self.next_sequence();
        CommandFrame { sequence, command, job: None, owner: self.owner, epoch: self.epoch, token: 0, argument: 0 }
    }

    /// Reads the status repeatedly until `holds` returns true for it. Returns that status.
    ///
    /// # Errors
    /// The status shows a fault, the wait takes longer than [`SETTLE_TIMEOUT`], or a request fails.
    async fn wait_until(&mut self, holds: impl Fn(&StatusBlock) -> bool) -> Result<StatusBlock, DeviceError> {
        let began = Instant::now();
        loop {
            let status = self.read_status_block().await?;
            if holds(&status) {
                return Ok(status);
            }
            let machine = self.machine();
            if status.fault != Fault::None {
                return Err(DeviceError::Faulted { machine, state: status.state, fault: status.fault });
            }
            if began.elapsed() > SETTLE_TIMEOUT {
                return Err(DeviceError::TimedOut { machine, operation: "the state announced", limit: SETTLE_TIMEOUT });
            }
            sleep(Duration::from_millis(5)).await;
        }
    }

    /// Checks that the job in `status` is `job`.
    ///
    /// # Errors
    /// The job number, the cycle or the digest (checksum of the payloads) differs, or the status has no job.
    pub(super) fn check_job(&self, job: Job, status: &StatusBlock) -> Result<(), DeviceError> {
        let held = status.job.unwrap_or(Job { job: 0, cycle: 0, digest: 0 });
        let fields = [
            ("the job", u64::from(job.job), u64::from(held.job)),
            ("the cycle", u64::from(job.cycle), u64::from(held.cycle)),
            ("the digest of the payloads", u64::from(job.digest), u64::from(held.digest)),
        ];
        self.compare(fields)
    }

    /// Compares the values that this client sent with the values at the machine. Each entry of `fields` is the name of
    /// the value for messages, the value sent, and the value at the machine.
    ///
    /// # Errors
    /// Returns [`DeviceError::Mismatch`] for the first entry whose two values differ.
    pub(super) fn compare<const N: usize>(&self, fields: [(&'static str, u64, u64); N]) -> Result<(), DeviceError> {
        match fields.into_iter().find(|(_, sent, held)| sent != held) {
            Some((field, sent, held)) => {
                Err(DeviceError::Mismatch { machine: self.machine(), field, sent, found: held })
            }
            None => Ok(()),
        }
    }
}

/// Returns the outcome of the start `intended` that `status` shows: the job runs, has finished, or its outcome cannot
/// be determined. Returns `None` if the status shows that the machine did not accept the start. The caller must confirm
/// `None` with a second, later status.
fn start_outcome(intended: &Armed, status: &StatusBlock) -> Option<Reconciled> {
    let Armed { job, start_sequence, boot_id, .. } = *intended;
    let unknown = |reason: String| Some(Reconciled::Unknown { reason });
    if status.boot_id != boot_id {
        let is = status.boot_id;
        return unknown(format!(
            "the machine was restarted after this job was prepared (boot id {boot_id:08x}, now {is:08x}); check at the machine whether the job was done"
        ));
    }
    if status.begun_by == start_sequence {
        return match status.job {
            Some(held) if held != job => {
                unknown(format!("START number {start_sequence} began {held} instead of {job}"))
            }
            _ if status.done == start_sequence => Some(Reconciled::Finished(status.into())),
            _ => match status.state {
                MachineState::Execute
                | MachineState::Holding
                | MachineState::Held
                | MachineState::Stopping
                | MachineState::Aborting => Some(Reconciled::Running(status.into())),
                MachineState::Aborted | MachineState::Faulted => Some(Reconciled::Finished(status.into())),
                state => unknown(format!(
                    "the machine accepted START number {start_sequence}, but is in {state} and has no result of this START"
                )),
            },
        };
    }
    let begun = status.last_begun == (job.job, job.cycle);
    match status.state {
        MachineState::Idle | MachineState::Prepared if !begun => None,
        _ if begun => unknown(format!(
            "START number {} began {job}, but this program sent number {start_sequence}",
            status.begun_by
        )),
        state => unknown(format!(
            "the machine is in {state} with another job; START number {} began that job",
            status.begun_by
        )),
    }
}
