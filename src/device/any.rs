//! A machine by whatever wire the cell file says: what the drive holds.

use super::exchange::{CmmMailbox, ExchangeCmm, ExchangeGrinder, GrinderMailbox, Step};
use super::{
    Armed, Cmm, CorrectionMap, DeviceError, Grinder, Identity, Interrupt, Job, Machine, Measurement, ModbusCmm,
    ModbusGrinder, Pass, PassRecord, Plan, Reconciled, Started, Status,
};

/// A choice between drivers, which answers as the one that was chosen.
macro_rules! any_machine {
    ($(#[$doc:meta])* $any:ident<$folders:ident: $mailbox:ident> { $($(#[$says:meta])* $wire:ident($driver:ty)),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug)]
        // There are two of these in a program; nothing is gained by a box.
        #[allow(clippy::large_enum_variant)]
        pub enum $any<$folders: $mailbox> {
            $($(#[$says])* $wire($driver)),+
        }

        $(impl<$folders: $mailbox> From<$driver> for $any<$folders> {
            fn from(driver: $driver) -> Self {
                Self::$wire(driver)
            }
        })+

        impl<$folders: $mailbox> Machine for $any<$folders> {
            fn name(&self) -> &str {
                match self { $(Self::$wire(machine) => machine.name()),+ }
            }
            fn notes(&self) -> Vec<String> {
                match self { $(Self::$wire(machine) => Machine::notes(machine)),+ }
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
    AnyCmm<M: CmmMailbox> {
        /// By Modbus.
        Modbus(ModbusCmm),
        /// By files.
        Files(ExchangeCmm<M>),
    }
);

any_machine!(
    /// A grinder by whatever wire.
    AnyGrinder<M: GrinderMailbox> {
        /// By Modbus.
        Modbus(ModbusGrinder),
        /// By files.
        Files(ExchangeGrinder<M>),
    }
);

impl<M: CmmMailbox> Cmm for AnyCmm<M> {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        match self {
            Self::Modbus(cmm) => cmm.load_plan(plan, interrupt).await,
            Self::Files(cmm) => cmm.load_plan(plan, interrupt).await,
        }
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        match self {
            Self::Modbus(cmm) => cmm.collect(job, interrupt).await,
            Self::Files(cmm) => Cmm::collect(cmm, job, interrupt).await,
        }
    }
}

impl<M: GrinderMailbox> Grinder for AnyGrinder<M> {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Result<(), DeviceError> {
        match self {
            Self::Modbus(grinder) => grinder.load_pass(map, pass, interrupt).await,
            Self::Files(grinder) => grinder.load_pass(map, pass, interrupt).await,
        }
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
        match self {
            Self::Modbus(grinder) => grinder.collect(job, interrupt).await,
            Self::Files(grinder) => Grinder::collect(grinder, job, interrupt).await,
        }
    }

    async fn confirm(&mut self, step: Step, map_identity: [u8; 32]) -> Result<(), DeviceError> {
        match self {
            Self::Modbus(grinder) => grinder.confirm(step, map_identity).await,
            Self::Files(grinder) => grinder.confirm(step, map_identity).await,
        }
    }
}
