//! Common interface of the drivers of both kinds of machine, and what they transfer.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use crate::cell::Device;
use crate::device::{
    Cmm, CorrectionMap, DeviceError, Grinder, Identified as _, Interrupt, Job, Machine, Measurement, Pass, PassRecord,
    Plan, PreliminaryPoints, digest,
};

/// Payload of a machine: a plan for the CMM, or a map and a pass for the grinder.
#[derive(Clone)]
pub(in super::super) enum MachinePayload {
    Plan(Arc<Plan>),
    Pass(Arc<CorrectionMap>, Box<Pass>),
}

/// Result of a job, as read from the machine.
pub(in super::super) enum FetchedResult {
    /// Points, with the duration of their transfer.
    Points(Box<Measurement>, Duration),
    Record(Box<PassRecord>),
}

/// Common interface of the drivers of both kinds of machine.
pub(in super::super) trait StationDriver: Send + 'static {
    type Machine: Machine;
    const DEVICE: Device;
    fn machine(&mut self) -> &mut Self::Machine;
    /// Transfers a payload (the pass with its correction map, or the measuring plan) to the machine. Returns the digest
    /// (a short hash) of the identities of its contents. A job names the payload by this digest. `interrupt` cancels
    /// the transfer.
    fn load(
        &mut self,
        load: &MachinePayload,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<u32, DeviceError>> + Send;
    fn fetch(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<FetchedResult, DeviceError>> + Send;
    /// Reads new preliminary points of a job that still runs. See [`Cmm::read_ahead`]. The default implementation
    /// always returns `None`.
    fn read_ahead(&mut self, _job: Job, _: &Interrupt) -> impl Future<Output = Option<PreliminaryPoints>> + Send {
        std::future::ready(None)
    }
}

pub(in super::super) struct CmmDriver<C>(pub(in super::super) C);

pub(in super::super) struct GrinderDriver<G>(pub(in super::super) G);

impl<C: Cmm + 'static> StationDriver for CmmDriver<C> {
    type Machine = C;
    const DEVICE: Device = Device::Cmm;

    fn machine(&mut self) -> &mut C {
        &mut self.0
    }

    async fn load(&mut self, load: &MachinePayload, interrupt: &Interrupt) -> Result<u32, DeviceError> {
        let MachinePayload::Plan(plan) = load else { unreachable!("the drive gives a CMM plans only") };
        self.0.load_plan(plan, interrupt).await?;
        Ok(digest(&[plan.identity()]))
    }

    async fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> Result<FetchedResult, DeviceError> {
        let began = Instant::now();
        let measurement = self.0.collect(job, interrupt).await?;
        Ok(FetchedResult::Points(Box::new(measurement), began.elapsed()))
    }

    fn read_ahead(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Option<PreliminaryPoints>> + Send {
        self.0.read_ahead(job, interrupt)
    }
}

impl<G: Grinder + 'static> StationDriver for GrinderDriver<G> {
    type Machine = G;
    const DEVICE: Device = Device::Grinder;

    fn machine(&mut self) -> &mut G {
        &mut self.0
    }

    async fn load(&mut self, load: &MachinePayload, interrupt: &Interrupt) -> Result<u32, DeviceError> {
        let MachinePayload::Pass(map, pass) = load else { unreachable!("the drive gives a grinder passes only") };
        self.0.load_pass(map, pass, interrupt).await?;
        Ok(digest(&[map.identity(), pass.identity()]))
    }

    async fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> Result<FetchedResult, DeviceError> {
        Ok(FetchedResult::Record(Box::new(self.0.collect(job, interrupt).await?)))
    }
}
