//! Placeholder for a machine that a wire does not support: some wires are for measuring machines only, others for
//! grinders only.

use super::error::DeviceResult;
use super::handshake::{Armed, Identity, Job, Reconciled, Started, Status};
use super::machine::{Cmm, Grinder, Interrupt, Machine};
use super::payload::{CorrectionMap, Measurement, Pass, PassRecord, Plan};

/// Type of a machine that a wire does not support. It has no values.
#[derive(Debug)]
pub enum NoMachine {}

impl Machine for NoMachine {
    fn name(&self) -> &str {
        match *self {}
    }
    async fn connect(&mut self) -> DeviceResult<Identity> {
        match *self {}
    }
    async fn status(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn claim(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn prepare(&mut self, _: Job) -> DeviceResult<Armed> {
        match *self {}
    }
    async fn start(&mut self, _: Armed) -> DeviceResult<Started> {
        match *self {}
    }
    async fn hold(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn resume(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn stop(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn abort(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn clear(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn acknowledge(&mut self, _: u32) -> DeviceResult<Status> {
        match *self {}
    }
    async fn release(&mut self) -> DeviceResult<Status> {
        match *self {}
    }
    async fn reconcile(&mut self, _: &Armed) -> DeviceResult<Reconciled> {
        match *self {}
    }
}

impl Grinder for NoMachine {
    async fn load_pass(&mut self, _: &CorrectionMap, _: &Pass, _: &Interrupt) -> DeviceResult<()> {
        match *self {}
    }
    async fn collect(&mut self, _: Job, _: &Interrupt) -> DeviceResult<PassRecord> {
        match *self {}
    }
}

impl Cmm for NoMachine {
    async fn load_plan(&mut self, _: &Plan, _: &Interrupt) -> DeviceResult<()> {
        match *self {}
    }
    async fn collect(&mut self, _: Job, _: &Interrupt) -> DeviceResult<Measurement> {
        match *self {}
    }
}
