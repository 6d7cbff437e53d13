//! Machines of a run: a task for each, and the channels to and from these tasks.

use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use super::machine_monitor::MachineMonitor;
use super::station::{
    AbortCounter, CmmDriver, GrinderDriver, LoopWatchdog, MachineTask, StationDriver, StationReport, StationRequest,
};
use crate::cell::{Command, Device};
use crate::device::{Armed, Cmm, Grinder, Interrupt};
use crate::formats::operator_step::OperatorStep;
use crate::record::StartIntent;

/// Machines of a run: CMM, grinder. Each has a task of its own.
pub(super) struct Machines {
    requests: [mpsc::Sender<StationRequest>; 2],
    interrupts: [Interrupt; 2],
    /// Number of aborts ordered for each station. When the number increases, the station cancels the request in
    /// progress.
    abort_counts: [watch::Sender<u64>; 2],
    pub(super) watchdog: LoopWatchdog,
    pub(super) reports: mpsc::Receiver<StationReport>,
    /// Last preparation of each machine.
    pub(super) prepared: [Option<StartIntent>; 2],
    /// Notes of each machine on why it waits, in words.
    pub(super) notes: [Vec<String>; 2],
    /// Step that each machine asks of a person.
    pub(super) steps: [Option<OperatorStep>; 2],
    /// Last status of each machine and the courses of its values.
    pub(super) monitors: [MachineMonitor; 2],
    tasks: [JoinHandle<()>; 2],
}

/// Last preparation of a machine by an interrupted program, with its cycle, and whether the machine may still execute
/// this job.
type EarlierPreparation = (Option<(u32, Armed)>, bool);

impl Machines {
    /// Creates a task for each machine. Sends no command to a machine. `job` is the number of the run. `earlier` are the
    /// last preparations of an interrupted program, and `prepared` their recorded form. `poll` is the poll interval of
    /// each machine.
    pub(super) fn new<C: Cmm + 'static, G: Grinder + 'static>(
        (cmm, grinder): (C, G),
        job: u32,
        (earlier, prepared): ([EarlierPreparation; 2], [Option<StartIntent>; 2]),
        poll: [Duration; 2],
    ) -> Self {
        let (reports, reported) = mpsc::channel(64);
        let interrupts = [Interrupt::new(), Interrupt::new()];
        let abort_counts = [watch::Sender::new(0), watch::Sender::new(0)];
        let watchdog = LoopWatchdog::new();
        let [of_cmm, of_grinder] = earlier;
        let monitors = Device::BOTH.map(MachineMonitor::new);
        let of = |k: usize| (&interrupts[k], &abort_counts[k], &watchdog, &monitors[k]);
        let (to_cmm, cmm) = spawn_station(CmmDriver(cmm), job, of(0), &reports, of_cmm, poll[0]);
        let (to_grinder, grinder) = spawn_station(GrinderDriver(grinder), job, of(1), &reports, of_grinder, poll[1]);
        Self {
            requests: [to_cmm, to_grinder],
            interrupts,
            abort_counts,
            watchdog,
            reports: reported,
            prepared,
            notes: [Vec::new(), Vec::new()],
            steps: [None, None],
            monitors,
            tasks: [cmm, grinder],
        }
    }

    /// Sends a request to the task of a machine.
    pub(super) async fn send(&self, device: Device, request: StationRequest) {
        // A station lives as long as the drive; its channel is large enough for the work of one cell.
        let _ = self.requests[device as usize].send(request).await;
    }

    /// Sends a request to the task of a machine, which interrupts a transfer in progress.
    pub(super) async fn send_urgent(&self, device: Device, request: StationRequest) {
        self.interrupts[device as usize].raise();
        self.send(device, request).await;
    }

    /// Orders an abort of a machine. Its task cancels the request in progress.
    pub(super) async fn abort(&self, device: Device) {
        self.abort_counts[device as usize].send_modify(|ordered| *ordered += 1);
        self.send_urgent(device, StationRequest::Command(Command::AbortMachine { device })).await;
    }

    /// Ends the tasks: each releases its machine. Waits at most 2 s for each.
    pub(super) async fn release(&mut self) {
        // Without further requests, each station releases its machine and ends.
        self.requests = [mpsc::channel(1).0, mpsc::channel(1).0];
        for task in &mut self.tasks {
            let _ = tokio::time::timeout(Duration::from_secs(2), task).await;
        }
    }
}

fn spawn_station<D: StationDriver>(
    driver: D,
    job: u32,
    (interrupt, aborts, pulse, monitor): (&Interrupt, &watch::Sender<u64>, &LoopWatchdog, &MachineMonitor),
    reports: &mpsc::Sender<StationReport>,
    (armed, may_be_at_work): (Option<(u32, Armed)>, bool),
    poll: Duration,
) -> (mpsc::Sender<StationRequest>, tokio::task::JoinHandle<()>) {
    let (asks, asked) = mpsc::channel(16);
    let station = MachineTask::new(driver, job, (interrupt.clone(), monitor.clone()), reports.clone(), armed);
    let station = if may_be_at_work { station.restore_preparation() } else { station };
    (asks, tokio::spawn(station.serve(asked, poll, AbortCounter::new(aborts.subscribe()), pulse.clone())))
}
