//! Connection of a station to its machine: the first one, the one for an abort, and the one after a lost link.

use std::time::Duration;

use tokio::time::Instant;

use super::MachineTask;
use super::driver::StationDriver;
use super::translation::{describe_job, mismatch};
use crate::cell::{ConnectionRefusal, Event, Occupation};
use crate::device::{DeviceError, Machine as _, MachineState, Status};
use crate::record::EventDetail;

/// Maximum time between two attempts to reach a lost machine.
const MAX_RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// Minimum duration of a link after which a new loss starts a new series of losses.
const STABLE_LINK_TIME: Duration = Duration::from_secs(10);

impl<B: StationDriver> MachineTask<B> {
    pub(super) async fn connect(&mut self) {
        let connected = async {
            let identity = self.driver.machine().connect().await?;
            let status = self.driver.machine().status().await?;
            // Do not take over a machine that runs the job of another run.
            if self.has_foreign_job(&status) {
                return Ok((identity, Err(describe_job(&status))));
            }
            let status = self.driver.machine().claim().await?;
            Ok::<_, DeviceError>((identity, Ok(status)))
        };
        match connected.await {
            Ok((_, Err(occupation))) => {
                self.report(Event::NotConnected {
                    device: B::DEVICE,
                    reason: ConnectionRefusal::AtAnotherJob(occupation),
                })
                .await;
            }
            Ok((identity, Ok(status))) => {
                self.observed.connected = true;
                self.observed.state = Some(status.state);
                let occupation = self.occupation(&status).await;
                let (device, boot_id, simulated) = (B::DEVICE, identity.boot_id, identity.simulation);
                let (name, address) = (identity.name.clone(), self.driver.machine().name().to_string());
                let detail = EventDetail::Machine { name, address };
                self.report_with_detail(Event::Connected { device, boot_id, simulated, occupation }, Some(detail))
                    .await;
            }
            Err(error) => self.report(Event::NotConnected { device: B::DEVICE, reason: mismatch(&error) }).await,
        }
    }

    /// Returns whether a machine that was just connected is idle, busy, or must be cleared. If an earlier client has
    /// prepared a job but not started it, sends STOP to withdraw this preparation. The machine is then idle, or busy if
    /// STOP fails.
    async fn occupation(&mut self, status: &Status) -> Occupation {
        match status.state {
            MachineState::Idle => Occupation::Idle,
            MachineState::Aborted | MachineState::Faulted => Occupation::ToClear,
            MachineState::Prepared => match self.driver.machine().stop().await {
                Ok(_) => Occupation::Idle,
                Err(error) => Occupation::Busy(error.to_string()),
            },
            _ => Occupation::Busy(describe_job(status)),
        }
    }

    fn has_foreign_job(&self, status: &Status) -> bool {
        let at_a_job = status.state.is_moving() || matches!(status.state, MachineState::Held | MachineState::Complete);
        at_a_job && status.job.is_none_or(|job| job.job != self.job)
    }

    /// Connects to a machine before an abort, if this program has not connected to it yet. Returns an error if the
    /// machine has a job of another run, or refuses the connection. Returns `Ok` if the machine cannot be reached,
    /// because the abort itself then reports the failure.
    pub(super) async fn connect_for_abort(&mut self) -> Result<(), String> {
        let met = async {
            self.driver.machine().connect().await?;
            self.driver.machine().status().await
        };
        match met.await {
            Ok(status) if self.has_foreign_job(&status) => {
                Err(format!("the machine has a job of another run: {}", describe_job(&status)))
            }
            Ok(_) => {
                self.observed.connected = true;
                Ok(())
            }
            Err(error) if error.is_link() => Ok(()),
            Err(error) => Err(error.to_string()),
        }
    }

    pub(super) async fn report_link_lost(&mut self, error: &DeviceError) {
        if !std::mem::replace(&mut self.observed.link_lost, true) {
            self.monitor.add_lost_link();
            if self.observed.reconnected_at.is_none_or(|back| back.elapsed() > STABLE_LINK_TIME) {
                self.observed.attempts = 0;
            } else {
                self.schedule_next_attempt();
            }
            let answers = if error.is_link() {
                ""
            } else {
                "the machine answers, but its answer contradicts the cell file or docs/modbus.md: "
            };
            self.report(Event::LinkLost { device: B::DEVICE, reason: format!("{answers}{error}") }).await;
        }
    }

    pub(super) async fn reconnect(&mut self) {
        if self.observed.next_attempt.is_some_and(|at| Instant::now() < at) {
            return;
        }
        let reached = async {
            let identity = self.driver.machine().connect().await?;
            // An abort needs no owner, and neither does the check of its effect.
            if !self.observed.aborting {
                self.driver.machine().claim().await?;
            }
            Ok::<_, DeviceError>(identity)
        };
        match reached.await {
            Ok(identity) => {
                self.observed.link_lost = false;
                self.observed.reconnected_at = Some(Instant::now());
                self.observed.state = None;
                self.report(Event::LinkBack { device: B::DEVICE, boot_id: identity.boot_id }).await;
            }
            Err(_) => self.schedule_next_attempt(),
        }
    }

    fn schedule_next_attempt(&mut self) {
        let pause = Duration::from_millis(100) * 2u32.saturating_pow(self.observed.attempts.min(10));
        self.observed.attempts += 1;
        self.observed.next_attempt = Some(Instant::now() + pause.min(MAX_RETRY_INTERVAL));
    }
}
