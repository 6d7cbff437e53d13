//! Table of the drivers, one line each: the name in a cell file, and the folder that owns the rest.

use schemars::JsonSchema;
use serde::Deserialize;

use super::driver_factory::{DriverContext, DriverError, DriverFactory};
use super::file_exchange::ExchangeWire;
use super::hit_lines::{HitLinesWire, HitSource};
use super::ippdme::IppdmeWire;
use super::linuxcnc::LinuxcncWire;
use super::machine::{Cmm, Grinder, Interrupt, Machine};
use super::machine_table::MachineTable;
use super::manual::ManualWire;
use super::modbus::{LineAddress, Link, RtuWire, TcpWire};
use super::{
    Armed, CorrectionMap, DeviceError, Identity, Job, Measurement, OperatorConfirmation, Pass, PassRecord, Plan,
    PreliminaryPoints, Reconciled, Started, Status,
};
use regrind_document::Document;
use regrind_formats::result::Coordinates;

macro_rules! drivers {
    ($($(#[$doc:meta])* $wire:ident($table:ty)),+ $(,)?) => {
        /// The wire to a machine.
        #[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
        #[serde(tag = "kind", rename_all = "kebab-case")]
        pub enum Wire {
            $($(#[$doc])* $wire($table)),+
        }

        /// Measuring machine on any wire.
        #[derive(Debug)]
        // A program has two of these; boxing would gain nothing.
        #[allow(clippy::large_enum_variant)]
        pub enum AnyCmm {
            $($(#[$doc])* $wire(<$table as DriverFactory>::Cmm)),+
        }

        /// Grinder on any wire.
        #[derive(Debug)]
        #[allow(clippy::large_enum_variant)]
        pub enum AnyGrinder {
            $($(#[$doc])* $wire(<$table as DriverFactory>::Grinder)),+
        }

        impl Wire {
            /// Reports to the document the errors of this wire that the schema does not detect.
            pub fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
                match self { $(Self::$wire(wire) => DriverFactory::check(wire, place, document)),+ }
            }

            /// Reports to the document the conflicts between this wire, which is that of the CMM, and the wire of the
            /// grinder.
            pub fn check_against_grinder(&self, grinder: &Self, document: &mut Document) {
                match (self, grinder) {
                    $((Self::$wire(cmm), Self::$wire(grinder)) => DriverFactory::check_against_grinder(cmm, grinder, document),)+
                    _ => {}
                }
            }

            /// Returns notes for a person about this wire on this computer, for example that a serial port does not
            /// exist.
            pub fn notes(&self) -> Vec<String> {
                match self { $(Self::$wire(wire) => wire.notes()),+ }
            }

            /// Returns true if a person operates the machine.
            pub fn is_by_person(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::BY_PERSON),+ }
            }

            /// Returns true if the results of a machine on this wire may contain a temperature.
            pub fn reports_temperature(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::REPORTS_TEMPERATURE),+ }
            }

            /// Returns true if the tables `registers` and `signals` of a cell file apply to this wire.
            pub fn has_registers(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::HAS_REGISTERS),+ }
            }

            /// Returns true if a grinder on this wire takes its program and its map from the folder of the run.
            pub fn reads_run_folder(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::READS_RUN_FOLDER),+ }
            }

            /// Returns whether the coordinates of a measurement are probe centres or contact points. Returns `None` if
            /// each result states this itself.
            pub fn coordinates(&self) -> Option<Coordinates> {
                match self { $(Self::$wire(wire) => wire.coordinates()),+ }
            }

            /// Returns the Modbus line and the unit number on it, or `None` if this is not a Modbus wire.
            pub fn modbus_line(&self) -> Option<(LineAddress, u8)> {
                match self { $(Self::$wire(wire) => DriverFactory::modbus_line(wire)),+ }
            }

            /// Returns host and port of the I++ DME server, or `None` if this is another wire.
            pub fn ippdme_address(&self) -> Option<(String, u16)> {
                match self { $(Self::$wire(wire) => DriverFactory::ippdme_address(wire)),+ }
            }

            /// Returns where the hit lines come from, or `None` if this wire has no hit lines.
            pub fn hit_source(&self) -> Option<HitSource> {
                match self { $(Self::$wire(wire) => DriverFactory::hit_source(wire)),+ }
            }

            /// Returns host and port of the server linuxcncrsh, or `None` if this is another wire.
            pub fn linuxcncrsh_address(&self) -> Option<(String, u16)> {
                match self { $(Self::$wire(wire) => DriverFactory::linuxcncrsh_address(wire)),+ }
            }

            /// Creates the driver of a measuring machine. Sends nothing to the machine yet.
            ///
            /// # Errors
            /// The errors of [`DriverFactory::create_cmm`].
            pub fn create_cmm(&self, making: &DriverContext<'_>) -> Result<AnyCmm, DriverError> {
                Ok(match self { $(Self::$wire(wire) => AnyCmm::$wire(wire.create_cmm(making)?)),+ })
            }

            /// Creates the driver of a grinder. Sends nothing to the machine yet.
            ///
            /// # Errors
            /// The errors of [`DriverFactory::create_grinder`].
            pub fn create_grinder(&self, making: &DriverContext<'_>) -> Result<AnyGrinder, DriverError> {
                Ok(match self { $(Self::$wire(wire) => AnyGrinder::$wire(wire.create_grinder(making)?)),+ })
            }
        }

        impl AnyCmm {
            /// Returns the Modbus line that the driver uses and that the driver of another machine may share. Returns
            /// `None` for other wires.
            pub fn link(&self) -> Option<&Link> {
                match self { $(Self::$wire(cmm) => <$table>::link(cmm)),+ }
            }
        }

        machine!(AnyCmm: $($wire),+);
        machine!(AnyGrinder: $($wire),+);

        impl Cmm for AnyCmm {
            async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
                match self { $(Self::$wire(cmm) => cmm.load_plan(plan, interrupt).await),+ }
            }
            async fn read_ahead(&mut self, job: Job, interrupt: &Interrupt) -> Option<PreliminaryPoints> {
                match self { $(Self::$wire(cmm) => cmm.read_ahead(job, interrupt).await),+ }
            }
            async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
                match self { $(Self::$wire(cmm) => Cmm::collect(cmm, job, interrupt).await),+ }
            }
        }

        impl Grinder for AnyGrinder {
            async fn load_pass(
                &mut self,
                map: &CorrectionMap,
                pass: &Pass,
                interrupt: &Interrupt,
            ) -> Result<(), DeviceError> {
                match self { $(Self::$wire(grinder) => grinder.load_pass(map, pass, interrupt).await),+ }
            }
            async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
                match self { $(Self::$wire(grinder) => Grinder::collect(grinder, job, interrupt).await),+ }
            }
        }
    };
}

/// Implements [`Machine`] for an enum of drivers: each call goes to the chosen driver.
macro_rules! machine {
    ($any:ident: $($wire:ident),+) => {
        impl Machine for $any {
            fn name(&self) -> &str {
                match self { $(Self::$wire(machine) => machine.name()),+ }
            }
            fn notes(&self) -> Vec<String> {
                match self { $(Self::$wire(machine) => Machine::notes(machine)),+ }
            }
            fn restore(&mut self, intended: &Armed) {
                match self { $(Self::$wire(machine) => machine.restore(intended)),+ }
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
            async fn confirm(&mut self, word: OperatorConfirmation) -> Result<Vec<String>, DeviceError> {
                match self { $(Self::$wire(machine) => machine.confirm(word).await),+ }
            }
        }
    };
}

drivers! {
    /// Modbus over TCP.
    ModbusTcp(TcpWire),
    /// Modbus over a serial line.
    ModbusRtu(RtuWire),
    /// Files in two folders, and a person.
    FileExchange(ExchangeWire),
    /// A person, step by step.
    Manual(ManualWire),
    /// I++ DME over TCP, for a measuring machine.
    Ippdme(IppdmeWire),
    /// LinuxCNC by linuxcncrsh over TCP, for a grinder.
    Linuxcnc(LinuxcncWire),
    /// A line for each hit, from a measuring machine that accepts no commands.
    HitLines(HitLinesWire),
}
