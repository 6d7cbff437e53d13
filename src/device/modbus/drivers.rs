//! Drivers of the measuring machine and of the grinder, which differ only in their payloads and results.

use std::io;

use super::link::Link;
use super::machine::ModbusMachine;
use super::protocol::{self, Payload};
use super::settings::ModbusSettings;
use crate::{
    Armed, Cmm, CorrectionMap, DeviceError, Grinder, Identity, Interrupt, Job, Machine, MachineCommand, MachineKind,
    Measurement, Outcome, Pass, PassRecord, Plan, PreliminaryPoints, Reconciled, Started, Status, digest,
};

/// Defines a driver that wraps a [`ModbusMachine`] and implements [`Machine`] with it.
macro_rules! modbus_driver {
    ($(#[$doc:meta])* $driver:ident, $kind:expr) => {
        $(#[$doc])*
        #[derive(Debug)]
        pub struct $driver(ModbusMachine);

        impl $driver {
            /// Creates the driver of a machine with its own Modbus line (TCP connection or serial port). Sends nothing
            /// until the machine is connected.
            ///
            /// # Errors
            /// The thread of the line cannot be started.
            pub fn new(settings: ModbusSettings) -> io::Result<Self> {
                let link = Link::new(settings.line.clone(), settings.request_timeout, settings.quarantine)?;
                Ok(Self::on(link, settings))
            }

            /// Creates the driver of a machine on the Modbus line `link`, which other machines may also use. The driver
            /// uses the address, the request timeout and the quarantine of `link`. It ignores those in `settings`.
            pub fn on(link: Link, settings: ModbusSettings) -> Self {
                Self(ModbusMachine::new($kind, link, settings))
            }

            /// Returns the Modbus line of this machine. Use it to read the statistics of the line, or to create the
            /// driver of another machine on the same line.
            pub fn link(&self) -> &Link {
                self.0.link()
            }
        }

        impl Machine for $driver {
            fn name(&self) -> &str {
                &self.0.unit.name
            }
            async fn connect(&mut self) -> Result<Identity, DeviceError> {
                self.0.connect().await
            }
            async fn status(&mut self) -> Result<Status, DeviceError> {
                self.0.status().await
            }
            async fn claim(&mut self) -> Result<Status, DeviceError> {
                self.0.claim().await.map(Status::from)
            }
            async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
                self.0.prepare(job).await
            }
            async fn start(&mut self, armed: Armed) -> Result<Started, DeviceError> {
                self.0.start(armed).await
            }
            async fn hold(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Hold).await.map(Status::from)
            }
            async fn resume(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Resume).await.map(Status::from)
            }
            async fn stop(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Stop).await.map(Status::from)
            }
            async fn abort(&mut self) -> Result<Status, DeviceError> {
                self.0.abort().await.map(Status::from)
            }
            async fn clear(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Clear).await.map(Status::from)
            }
            async fn acknowledge(&mut self, done: u32) -> Result<Status, DeviceError> {
                self.0.acknowledge(done).await.map(Status::from)
            }
            async fn release(&mut self) -> Result<Status, DeviceError> {
                self.0.release().await.map(Status::from)
            }
            async fn reconcile(&mut self, intended: &Armed) -> Result<Reconciled, DeviceError> {
                self.0.reconcile(intended).await
            }
        }
    };
}

modbus_driver!(
    /// Measuring machine that follows docs/modbus.md.
    ModbusCmm,
    MachineKind::Cmm
);

impl Cmm for ModbusCmm {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.0.load(plan, interrupt).await
    }

    async fn read_ahead(&mut self, job: Job, interrupt: &Interrupt) -> Option<PreliminaryPoints> {
        self.0.read_ahead(job, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        let machine = &mut self.0;
        let (status, header, words) = machine.fetch(job, 4, interrupt).await?;
        if status.outcome != Outcome::Complete {
            return Err(DeviceError::NoResult { machine: machine.machine(), job, state: status.state });
        }
        let measured = digest(&[header.identity]);
        machine.compare([("the digest of the plan that was measured", job.digest.into(), measured.into())])?;
        if let Some(slot) = machine.loaded.get(&Plan::KIND) {
            let targets = (u64::from(slot.bytes) - 64) / 56;
            machine.count("points of the measurement", targets, header.records.into())?;
        }
        let coordinates = machine.coordinates(&header)?;
        let points = words.chunks_exact(header.registers).map(|record| {
            let record = machine.unit.registers(record);
            protocol::decode_point(record, header.format, header.scale_mm).map_err(|flaw| machine.record_error(flaw))
        });
        Ok(Measurement {
            points: points.collect::<Result<_, _>>()?,
            coordinates,
            probe_radius_mm: Some(header.probe_radius_mm),
            temperature_c: header.temperature_c,
            duration_s: Some(header.duration_s),
            plan_identity: header.identity,
            job: job.job,
            cycle: job.cycle,
            done: status.done,
        })
    }
}

modbus_driver!(
    /// Grinder that follows docs/modbus.md.
    ModbusGrinder,
    MachineKind::Grinder
);

impl Grinder for ModbusGrinder {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.0.load(map, interrupt).await?;
        self.0.load(pass, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
        let machine = &mut self.0;
        let (status, header, words) = machine.fetch(job, 5, interrupt).await?;
        machine.count("pass records", 1, header.records.into())?;
        let figures =
            protocol::decode_pass_record(machine.unit.registers(&words)).map_err(|flaw| machine.record_error(flaw))?;
        let (number, cycle, outcome, [path_mm, removed_mm3, deepest_mm, idle_share, spindle_load, wheel_radius_mm]) =
            figures;
        machine.compare([
            ("the job in the pass record", u64::from(job.job), u64::from(number)),
            ("the cycle in the pass record", u64::from(job.cycle), u64::from(cycle)),
            ("the result in the pass record", status.outcome as u64, outcome as u64),
        ])?;
        if let Some(map) = machine.loaded.get(&CorrectionMap::KIND).filter(|map| map.identity != header.identity) {
            let (sent, held) = (digest(&[map.identity]).into(), digest(&[header.identity]).into());
            let field = "the CRC-32 of the identity of the map that the grinder used";
            return Err(DeviceError::Mismatch { machine: machine.machine(), field, sent, found: held });
        }
        Ok(PassRecord {
            outcome,
            path_mm: Some(path_mm),
            removed_mm3: Some(removed_mm3),
            max_depth_mm: Some(deepest_mm),
            idle_share: Some(idle_share),
            spindle_load: Some(spindle_load),
            wheel_radius_mm: Some(wheel_radius_mm),
            temperature_c: header.temperature_c,
            duration_s: Some(header.duration_s),
            map_identity: header.identity,
            job: job.job,
            cycle: job.cycle,
            done: status.done,
        })
    }
}
