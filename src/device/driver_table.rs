//! Table of the drivers, one line each: the name in a cell file, and the folder that owns the rest.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::driver_factory::{ConnectionCheck, DriverContext, DriverError, DriverFactory};
use super::file_exchange::ExchangeWire;
use super::hit_lines::HitLinesWire;
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
use regrind_formats::operator_step::OperatorStep;
use regrind_formats::result::Coordinates;

macro_rules! drivers {
    ($($(#[$doc:meta])* $wire:ident($table:ty)),+ $(,)?) => {
        /// The wire to a machine.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
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
            /// Checks this wire (the connection to one machine, from its table in the cell file). Reports each error
            /// that the schema of the cell file does not detect. The errors are added to the list of problems in
            /// `document`, which is the cell file while it is checked. `place` states whether the wire belongs to the
            /// CMM or to the grinder.
            pub fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
                match self { $(Self::$wire(wire) => DriverFactory::check(wire, place, document)),+ }
            }

            /// Compares this wire (the connection to the CMM) with the wire `grinder` (the connection to the grinder).
            /// Reports each conflict, for example a folder that both machines use. The conflicts are added to the list
            /// of problems in `document`, which is the cell file while it is checked. Reports nothing if the two wires
            /// are of different kinds.
            pub fn check_against_grinder(&self, grinder: &Self, document: &mut Document) {
                match (self, grinder) {
                    $((Self::$wire(cmm), Self::$wire(grinder)) => DriverFactory::check_against_grinder(cmm, grinder, document),)+
                    _ => {}
                }
            }

            /// Returns notes for a person about this wire (the connection to one machine) on this computer, for example
            /// that a serial port does not exist. Returns an empty list if there is nothing to report.
            pub fn notes(&self) -> Vec<String> {
                match self { $(Self::$wire(wire) => wire.notes()),+ }
            }

            /// Returns true if a person operates the machine on this wire (the connection to one machine). Such a job
            /// takes as long as the person needs.
            pub fn is_by_person(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::BY_PERSON),+ }
            }

            /// Returns true if the results of a machine on this wire may contain a temperature.
            pub fn reports_temperature(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::REPORTS_TEMPERATURE),+ }
            }

            /// Returns true if the tables `registers` and `signals` of a cell file apply to this wire (the connection
            /// to one machine). This is so for Modbus.
            pub fn has_registers(&self) -> bool {
                self.connection_check() == ConnectionCheck::Registers
            }

            /// Returns true if a grinder on this wire (the connection to one machine) reads its program and its
            /// correction map from the folder of the run.
            pub fn reads_run_folder(&self) -> bool {
                match self { $(Self::$wire(_) => <$table>::READS_RUN_FOLDER),+ }
            }

            /// Returns whether the points of a measurement through this wire (the connection to one machine) are probe
            /// centres or contact points. Returns `None` if the wire does not determine this; each result must then
            /// state it.
            pub fn coordinates(&self) -> Option<Coordinates> {
                match self { $(Self::$wire(wire) => wire.coordinates()),+ }
            }

            /// Returns the address of the Modbus line and the unit id of the machine on this line. The address is a
            /// host and a TCP port, or a serial port. Returns `None` if this wire (the connection to one machine) is
            /// not Modbus.
            pub fn modbus_line(&self) -> Option<(LineAddress, u8)> {
                match self { $(Self::$wire(wire) => DriverFactory::modbus_line(wire)),+ }
            }

            /// Returns the address of the machine in words, by which this computer tells it from all other machines.
            /// Returns `None` if this wire (the connection to one machine) has no address.
            pub fn address(&self) -> Option<String> {
                match self { $(Self::$wire(wire) => DriverFactory::address(wire)),+ }
            }

            /// Returns true if the address of the machine is assigned only when a simulated machine starts, for example
            /// with port 0.
            pub fn has_open_address(&self) -> bool {
                match self { $(Self::$wire(wire) => DriverFactory::has_open_address(wire)),+ }
            }

            /// Returns the check of this wire (the connection to one machine) that a program can make without a job.
            pub fn connection_check(&self) -> ConnectionCheck {
                match self { $(Self::$wire(_) => <$table>::CHECK),+ }
            }

            /// Returns advice for a person who must end a job of the machine, if no program can do that on this wire
            /// (the connection to one machine).
            pub fn end_of_job(&self) -> &'static str {
                match self { $(Self::$wire(_) => <$table>::END_OF_JOB),+ }
            }

            /// Creates the driver of a measuring machine on this wire. `context` contains the other data of the cell
            /// that the driver needs. Sends nothing to the machine yet.
            ///
            /// # Errors
            /// The errors of [`DriverFactory::create_cmm`], for example a serial port or a folder that does not exist.
            pub fn create_cmm(&self, context: &DriverContext<'_>) -> Result<AnyCmm, DriverError> {
                Ok(match self { $(Self::$wire(wire) => AnyCmm::$wire(wire.create_cmm(context)?)),+ })
            }

            /// Creates the driver of a grinder on this wire. `context` contains the other data of the cell that the
            /// driver needs. Sends nothing to the machine yet.
            ///
            /// # Errors
            /// The errors of [`DriverFactory::create_grinder`], for example a serial port or a folder that does not
            /// exist.
            pub fn create_grinder(&self, context: &DriverContext<'_>) -> Result<AnyGrinder, DriverError> {
                Ok(match self { $(Self::$wire(wire) => AnyGrinder::$wire(wire.create_grinder(context)?)),+ })
            }
        }

        impl AnyCmm {
            /// Returns the Modbus line that this driver uses. The driver of the other machine may share this line.
            /// Returns `None` if the machine is not connected by Modbus.
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

impl Wire {
    /// Replaces keys of this table (the connection to one machine), for example the port that a simulated machine has
    /// chosen.
    ///
    /// # Errors
    /// Returns an error if the table has no such key, or if a value is not valid for its key. The table is then
    /// unchanged.
    pub fn set_keys(&mut self, keys: serde_json::Map<String, serde_json::Value>) -> serde_json::Result<()> {
        let mut table = serde_json::to_value(&*self)?;
        if let Some(table) = table.as_object_mut() {
            table.extend(keys);
        }
        *self = serde_json::from_value(table)?;
        Ok(())
    }
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
            fn operator_step(&self) -> Option<OperatorStep> {
                match self { $(Self::$wire(machine) => machine.operator_step()),+ }
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
