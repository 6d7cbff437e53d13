//! The measuring machine that there is none of: LinuxCNC is for grinders.

use crate::error::Answered;
use crate::machine::{Cmm, Interrupt, Machine};
use crate::payload::{Measurement, Plan};
use crate::words::{Armed, Identity, Job, Reconciled, Started, Status};

/// No measuring machine can be had by LinuxCNC; this is the type of what cannot be.
#[derive(Debug)]
pub enum NoCmm {}

impl Machine for NoCmm {
    fn name(&self) -> &str {
        match *self {}
    }
    async fn connect(&mut self) -> Answered<Identity> {
        match *self {}
    }
    async fn status(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn claim(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn prepare(&mut self, _: Job) -> Answered<Armed> {
        match *self {}
    }
    async fn start(&mut self, _: Armed) -> Answered<Started> {
        match *self {}
    }
    async fn hold(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn resume(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn stop(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn abort(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn clear(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn acknowledge(&mut self, _: u32) -> Answered<Status> {
        match *self {}
    }
    async fn release(&mut self) -> Answered<Status> {
        match *self {}
    }
    async fn reconcile(&mut self, _: &Armed) -> Answered<Reconciled> {
        match *self {}
    }
}

impl Cmm for NoCmm {
    async fn load_plan(&mut self, _: &Plan, _: &Interrupt) -> Answered<()> {
        match *self {}
    }
    async fn collect(&mut self, _: Job, _: &Interrupt) -> Answered<Measurement> {
        match *self {}
    }
}
