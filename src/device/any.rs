//! A machine by whatever wire the cell file says: what the drive holds.

use super::{
    Armed, Cmm, CorrectionMap, DeviceError, Grinder, Identity, Interrupt, Job, Machine, Measurement, ModbusCmm,
    ModbusGrinder, Pass, PassRecord, Plan, Reconciled, Started, Status,
};

/// A choice between drivers, which answers as the one that was chosen.
macro_rules! any_machine {
    ($(#[$doc:meta])* $any:ident { $($(#[$says:meta])* $wire:ident($driver:ty)),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug)]
        pub enum $any {
            $($(#[$says])* $wire($driver)),+
        }

        $(impl From<$driver> for $any {
            fn from(driver: $driver) -> Self {
                Self::$wire(driver)
            }
        })+

        impl Machine for $any {
            fn name(&self) -> &str {
                match self { $(Self::$wire(machine) => machine.name()),+ }
            }
            async fn connect(&mut self) -> Result<Identity, DeviceError> {
                match self { $(Self::$wire(machine) => machine.connect().await),+ }
            }
            async fn status(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.status().await),+ }
            }
            async fn claim(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.claim().await),+ }
            }
            async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
                match self { $(Self::$wire(machine) => machine.prepare(job).await),+ }
            }
            async fn start(&mut self, armed: Armed) -> Result<Started, DeviceError> {
                match self { $(Self::$wire(machine) => machine.start(armed).await),+ }
            }
            async fn hold(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.hold().await),+ }
            }
            async fn resume(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.resume().await),+ }
            }
            async fn stop(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.stop().await),+ }
            }
            async fn abort(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.abort().await),+ }
            }
            async fn clear(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.clear().await),+ }
            }
            async fn acknowledge(&mut self, done: u32) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.acknowledge(done).await),+ }
            }
            async fn release(&mut self) -> Result<Status, DeviceError> {
                match self { $(Self::$wire(machine) => machine.release().await),+ }
            }
            async fn reconcile(&mut self, intended: &Armed) -> Result<Reconciled, DeviceError> {
                match self { $(Self::$wire(machine) => machine.reconcile(intended).await),+ }
            }
        }
    };
}

any_machine!(
    /// A measuring machine by whatever wire.
    AnyCmm {
        /// By Modbus.
        Modbus(ModbusCmm),
    }
);

any_machine!(
    /// A grinder by whatever wire.
    AnyGrinder {
        /// By Modbus.
        Modbus(ModbusGrinder),
    }
);

impl Cmm for AnyCmm {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        match self {
            Self::Modbus(cmm) => cmm.load_plan(plan, interrupt).await,
        }
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        match self {
            Self::Modbus(cmm) => cmm.collect(job, interrupt).await,
        }
    }
}

impl Grinder for AnyGrinder {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Result<(), DeviceError> {
        match self {
            Self::Modbus(grinder) => grinder.load_pass(map, pass, interrupt).await,
        }
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
        match self {
            Self::Modbus(grinder) => grinder.collect(job, interrupt).await,
        }
    }
}
