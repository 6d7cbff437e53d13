//! Execution of the commands of the cell.

use std::path::Path;
use std::sync::Arc;

use serde_json::{Value, json};

use super::Drive;
use super::notice::Notice;
use super::pipeline;
use super::running_computations::ComputationResult;
use super::station::{MachinePayload, StationRequest};
use super::task::ComputationProduct;
use crate::cell::{Actor, Command, ComparedFigure, Device, Ending, Event, Judgement, RecordFailure};
use crate::device::BatchId;
use crate::formats::run_files::{CycleFile, CycleFolder, RunFile};
use crate::journal;

impl Drive {
    pub(super) async fn execute(&mut self, command: Command) {
        match command {
            Command::Connect { device }
            | Command::VerifyClear { device }
            | Command::StartMachine { device, .. }
            | Command::ResumeMachine { device }
            | Command::ClearMachine { device }
            | Command::Reconcile { device, .. }
            | Command::Acknowledge { device } => self.machines.send(device, StationRequest::Command(command)).await,
            Command::HoldMachine { device } | Command::StopMachine { device } => {
                self.machines.send_urgent(device, StationRequest::Command(command)).await
            }
            Command::AbortMachine { device } => self.machines.abort(device).await,
            Command::Collect { .. } => self.machines.send(Device::Cmm, StationRequest::Command(command)).await,
            Command::AskToLoad => self.ask_to_load().await,
            Command::LoadPass { cycle } => self.load_pass(cycle).await,
            Command::LoadPlan { cycle } => self.load_plan(cycle).await,
            Command::AskWhetherClear { device } => self.notify(Notice::AskWhetherClear { device }),
            Command::Prepare { device, cycle } => {
                let batch = if device == Device::Cmm { self.cycles.batch(cycle) } else { 0 };
                self.machines.send(device, StationRequest::Prepare { number: BatchId { cycle, batch } }).await;
            }
            Command::Qualify { cycle } => self.qualify(cycle),
            Command::Register { cycle } => self.register(cycle),
            Command::Compensate { cycle } => self.compensate(cycle),
            Command::Announce(judgement) => self.announce(judgement).await,
            Command::Raise(alarm) => self.notify(Notice::Alarm(alarm)),
            Command::Withdraw { alarm } => self.notify(Notice::AlarmGone { alarm }),
            Command::Refuse { event, reason, .. } if event.is_order() => self.notify(Notice::Refused { reason }),
            // A late fact from a machine is recorded, but a person has nothing to do.
            Command::Refuse { .. } => {}
            Command::Finish(ending) => self.ending = Some(ending),
        }
    }

    pub(super) async fn ask_to_load(&mut self) {
        if self.context.load_confirmed {
            let simulation = || Actor { name: "simulation".into(), station: "regrind".into() };
            let actor = if self.task.simulation { simulation() } else { self.context.actor.clone() };
            self.queue_event(0, Event::LoadConfirmed { actor });
        } else {
            self.notify(Notice::LoadPart);
        }
    }

    /// Starts a check whether the disk has enough free space for the files of `cycle`. If it has not, reports this to
    /// the cell, which then holds before a machine moves. Data may still be sent to the machine before the result of
    /// the check arrives.
    pub(super) fn check_disk_space(&mut self, cycle: u32) {
        let (folder, needed) =
            (self.context.folder.clone(), self.task.cycle_bytes().max(2 * self.computations.max_cycle_bytes));
        self.computations.executor.spawn_computation(&mut self.computations.running, move || {
            let short = require_free_space(&folder, needed).err();
            let event = short.map(|reason| Event::RecordFailed { reason });
            ComputationResult { cycle, event, product: ComputationProduct::Nothing, files: Ok(Vec::new()) }
        });
    }

    pub(super) async fn load_pass(&mut self, number: u32) {
        self.check_disk_space(number);
        let (map, pass) = self.cycles.pass_payloads(&self.task, number);
        let load = MachinePayload::Pass(Arc::new(map), Box::new(pass));
        self.machines.send(Device::Grinder, StationRequest::Load { cycle: number, payload: load }).await;
    }

    pub(super) async fn load_plan(&mut self, number: u32) {
        self.check_disk_space(number);
        let load = MachinePayload::Plan(self.cycles.create_plan(&self.task, number));
        self.machines.send(Device::Cmm, StationRequest::Load { cycle: number, payload: load }).await;
    }

    /// Writes the judgement of a cycle to the file `result.json` in the folder of this cycle, and notifies people. A
    /// second judgement of the same cycle goes to a subfolder of its own.
    pub(super) async fn announce(&mut self, judgement: Judgement) {
        let which = self.cycles.count_judgement(judgement.cycle);
        self.write_judgement(which, &judgement).await;
        self.notify(Notice::Judged(judgement));
    }

    pub(super) async fn write_judgement(&mut self, which: u32, judgement: &Judgement) {
        let number = judgement.cycle;
        let cycle = self.cycles.get(number);
        let judged = cycle.and_then(|c| c.figures.as_ref()).map(|figures| self.cell.plan().tolerance.compare(figures));
        let mut result = json!({
            "simulation": self.task.simulation,
            "cycle": number,
            "verdict": judgement.verdict,
            "reason": judgement.reason,
            "figures": cycle.and_then(|c| c.figures.as_ref()),
            "judged": judged.map(|judged| judged.map(|of| judged_figure(&of))),
            "level_mm": cycle.map(|c| c.correction.level_mm),
        });
        if self.task.parameter_compensation.is_some() {
            result["parameters"] = json!(cycle.map(|cycle| pipeline::recorded_parameters(&self.task, cycle)));
        }
        let folder = CycleFolder::Attempt { cycle: number, attempt: which };
        self.write_document(format!("{folder}/{}", CycleFile::Judgement.name()), number, &result).await;
    }

    /// Writes the learned state of this run to the file `learned.json`. The next part of this kind can begin with this
    /// state. Does nothing if the run was stopped or aborted, or if no cycle gives a usable state.
    pub(super) async fn save_learned(&mut self, ending: &Ending) {
        if !matches!(ending, Ending::Accepted { .. } | Ending::NotAccepted { .. }) {
            return;
        }
        let run = self.context.folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let last = self.cycles.last_with_learning().cloned();
        let fields = self.cycles.part_priors(&self.task);
        let Some(learned) = last.and_then(|cycle| pipeline::learned_state(&self.task, run, (&cycle, fields))) else {
            return;
        };
        self.write_document(RunFile::Learned.name().into(), self.cell.cycle(), &learned).await;
    }
}

/// Returns an error if the disk of `folder` has less free space than `needed` bytes.
fn require_free_space(folder: &Path, needed: u64) -> Result<(), RecordFailure> {
    // If the free space is unknown, try to write.
    let free = journal::free_bytes(folder).unwrap_or(u64::MAX);
    if free >= needed {
        return Ok(());
    }
    let [free, needed] = [free, needed].map(|bytes| bytes.div_ceil(1 << 20));
    let disk = folder.display();
    Err(RecordFailure::DiskFull(format!("the disk of {disk} has {free} MB free, but a cycle needs up to {needed} MB")))
}

/// Converts a form figure that was compared with its limit (such as the PV) into JSON for the result file of a cycle.
/// The JSON contains the name, the value, the expanded uncertainty and the limit in mm, and the probability (0 to 1)
/// that the figure is within the limit. The limit is null if it is not finite.
fn judged_figure(of: &ComparedFigure) -> Value {
    json!({
        "name": of.name,
        "found_mm": of.median_mm,
        "expanded_mm": of.expanded_mm,
        "limit_mm": Some(of.limit_mm).filter(|limit| limit.is_finite()),
        "probability_within": of.probability_in_tolerance,
    })
}
