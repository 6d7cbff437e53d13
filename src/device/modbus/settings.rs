//! Modbus settings of a machine in a cell file, and all settings of its driver.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::parity::Parity;
use super::serial_port;
use crate::machine_table::MachineTable;
use crate::network_address::{HostTexts, check_address};
use regrind_document::Document;

/// Number of registers that a Modbus device can have.
const REGISTERS: u32 = 1 << 16;

/// First word of a value of several registers. Within a register, the high byte comes first, except with `badc` and
/// `dcba`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum WordOrder {
    /// The high one.
    #[default]
    Big,
    /// The low one.
    Little,
    /// The high one, and in each register the low byte before the high one.
    Badc,
    /// The low one, and in each register the low byte before the high one.
    Dcba,
}

impl WordOrder {
    /// Returns the name of the word order in a cell file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Big => "big",
            Self::Little => "little",
            Self::Badc => "badc",
            Self::Dcba => "dcba",
        }
    }

    /// Returns this word order with the words of a value in reverse order: high word first becomes low word first, and
    /// the reverse. The order of the bytes in each register does not change. Example: [`Self::Big`] becomes
    /// [`Self::Little`].
    pub fn with_words_swapped(self) -> Self {
        match self {
            Self::Big => Self::Little,
            Self::Little => Self::Big,
            Self::Badc => Self::Dcba,
            Self::Dcba => Self::Badc,
        }
    }

    /// Returns this word order with the two bytes of each register exchanged. The order of the words does not change.
    /// Example: [`Self::Big`] becomes [`Self::Badc`].
    pub fn with_bytes_swapped(self) -> Self {
        match self {
            Self::Big => Self::Badc,
            Self::Little => Self::Dcba,
            Self::Badc => Self::Big,
            Self::Dcba => Self::Little,
        }
    }

    /// Returns true if the low word of a value comes first.
    pub fn is_low_first(self) -> bool {
        matches!(self, Self::Little | Self::Dcba)
    }

    /// Returns true if the low byte of each register comes first.
    pub fn swaps_bytes(self) -> bool {
        matches!(self, Self::Badc | Self::Dcba)
    }

    /// Exchanges the two bytes of each register if the machine sends the low byte first (`badc` and `dcba`). Otherwise
    /// returns `words` unchanged. The conversion is the same for sent and for received registers.
    pub(super) fn bytes_in_order(self, mut words: Vec<u16>) -> Vec<u16> {
        if self.swaps_bytes() {
            words.iter_mut().for_each(|word| *word = word.swap_bytes());
        }
        words
    }
}

/// Address of a line.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[expect(missing_docs, reason = "the fields are told above them")]
pub enum LineAddress {
    /// Modbus TCP: a host by name or address, and a port, 502 by the standard.
    Tcp { host: String, port: u16 },
    /// Modbus RTU on a serial port, preferably by its persistent name under /dev/serial/by-id, with the baud rate in
    /// bit/s and 1 or 2 stop bits.
    Rtu { device: String, baud: u32, parity: Parity, stop_bits: u8 },
}

impl std::fmt::Display for LineAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tcp { host, port } => write!(f, "{host}:{port}"),
            Self::Rtu { device, baud, .. } => write!(f, "{device} ({baud} baud)"),
        }
    }
}

/// Modbus over TCP.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TcpWire {
    /// Name or address.
    #[schemars(length(min = 1, max = 253), extend("x-required" = true), example = "192.168.0.10")]
    pub host: String,
    /// Port; 0, in a simulated cell only, selects a free port at the start.
    #[schemars(range(min = 0, max = 65535))]
    pub port: u16,
    /// Unit identifier.
    #[schemars(range(min = 0, max = 255))]
    pub unit: u8,
}

impl Default for TcpWire {
    fn default() -> Self {
        Self { host: String::new(), port: 502, unit: 1 }
    }
}

impl TcpWire {
    pub(super) fn line(&self) -> LineAddress {
        LineAddress::Tcp { host: self.host.clone(), port: self.port }
    }

    pub(super) fn check_address(&self, place: &MachineTable<'_>, document: &mut Document) {
        let texts = HostTexts {
            allowed: "only a host name or an IP address is allowed, such as \"192.168.0.10\"",
            remedy: "write the port into its own key, `port`",
        };
        let usual_port = "the usual port of Modbus TCP is 502";
        check_address((&self.host, self.port), (&texts, usual_port), place, document);
    }

    /// Returns `None` always, because a program cannot know whether a network address exists before it tries to
    /// connect. For a serial port, the method with the same name returns a message if the port does not exist.
    pub(super) fn missing(&self) -> Option<String> {
        None
    }

    /// Compares the network address of the CMM (`self`) with the address of `grinder`. Reports a problem to `document`
    /// if host, port and unit (number of the machine on the line) are all the same. Does not report a problem if the
    /// port is 0.
    pub(super) fn compare(&self, grinder: &Self, document: &mut Document) {
        if self == grinder && self.port != 0 {
            let found = format!("is {}, but the CMM at the same host and port has this unit number too", grinder.unit);
            let allowed = "each machine requires its own unit number or its own port";
            document.report("grinder.wire.unit", found, allowed, "correct one of them");
        }
    }
}

/// Modbus over a serial line, eight data bits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RtuWire {
    /// Name of the serial device in the operating system.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "/dev/ttyUSB0")]
    pub device: String,
    /// Bits per second.
    #[schemars(range(min = 1200, max = 4000000))]
    pub baud: u32,
    /// Parity.
    pub parity: Parity,
    /// Stop bits.
    #[schemars(range(min = 1, max = 2))]
    pub stop_bits: u8,
    /// Unit identifier.
    #[schemars(range(min = 1, max = 247))]
    pub unit: u8,
}

impl Default for RtuWire {
    fn default() -> Self {
        Self { device: String::new(), baud: 115_200, parity: Parity::Even, stop_bits: 1, unit: 1 }
    }
}

impl RtuWire {
    pub(super) fn line(&self) -> LineAddress {
        let Self { device, baud, parity, stop_bits, .. } = self.clone();
        LineAddress::Rtu { device, baud, parity, stop_bits }
    }

    /// Does nothing. The name of a serial port can be checked only on the computer that has the port; [`Self::missing`]
    /// does that.
    pub(super) fn check_address(&self, _: &MachineTable<'_>, _: &mut Document) {}

    /// Compares the serial settings of the CMM (`self`) with the settings of `grinder`. Does nothing if the two
    /// machines use different serial ports. Reports a problem to `document` if both machines have the same unit number
    /// on one port, and another problem if speed, parity or stop bits differ.
    pub(super) fn compare(&self, grinder: &Self, document: &mut Document) {
        if self.device != grinder.device {
            return;
        }
        if self.unit == grinder.unit {
            let found = format!("is {}, but the CMM on the same line has this unit number too", grinder.unit);
            let allowed = "each machine on a line requires its own unit number";
            document.report("grinder.wire.unit", found, allowed, "correct one of them");
        }
        if self.line() != grinder.line() {
            let found = "differs from the CMM on the same line in speed, parity or stop bits";
            document.report("grinder.wire", found, "a line has only one setting", "make them the same");
        }
    }

    /// Returns a message if the serial port does not exist on this computer, with the names of the existing ports.
    /// Returns `None` if the port exists or its name is empty.
    pub(super) fn missing(&self) -> Option<String> {
        serial_port::missing(&self.device)
    }
}

/// Addresses of the blocks of docs/modbus.md, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RegisterMap {
    /// First word of a value of several registers: big is the high one.
    pub word_order: WordOrder,
    /// Identity, 32 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub identity: u16,
    /// Sync, 4 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub sync: u16,
    /// Beat, 3 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub beat: u16,
    /// Command, 20 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub command: u16,
    /// Status, 48 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub status: u16,
    /// In force, 72 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub in_force: u16,
    /// Inbox header, 24 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub inbox_header: u16,
    /// Inbox page, 120 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub inbox_page: u16,
    /// Inbox state, 12 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub inbox_state: u16,
    /// Outbox header, 56 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub outbox_header: u16,
    /// Outbox select, 2 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub outbox_select: u16,
    /// Outbox page, 116 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub outbox_page: u16,
}

impl Default for RegisterMap {
    fn default() -> Self {
        Self {
            word_order: WordOrder::Big,
            identity: 0,
            sync: 32,
            beat: 36,
            command: 40,
            status: 64,
            in_force: 120,
            inbox_header: 200,
            inbox_page: 224,
            inbox_state: 350,
            outbox_header: 400,
            outbox_select: 460,
            outbox_page: 462,
        }
    }
}

impl RegisterMap {
    /// Returns every block of Modbus registers: its key in a cell file, the address of its first register, and its
    /// number of registers.
    pub fn blocks(&self) -> [(&'static str, u16, u16); 12] {
        [
            ("identity", self.identity, 32),
            ("sync", self.sync, 4),
            ("beat", self.beat, 3),
            ("command", self.command, 20),
            ("status", self.status, 48),
            ("in_force", self.in_force, 72),
            ("inbox_header", self.inbox_header, 24),
            ("inbox_page", self.inbox_page, 120),
            ("inbox_state", self.inbox_state, 12),
            ("outbox_header", self.outbox_header, 56),
            ("outbox_select", self.outbox_select, 2),
            ("outbox_page", self.outbox_page, 116),
        ]
    }

    /// Checks the addresses of the register blocks. Reports to `document` each block that overlaps another block or
    /// ends after register 65535. `place` is the table of this machine in the cell file. It gives the full key for the
    /// messages.
    pub fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
        let blocks = self.blocks();
        for (k, &(name, first, count)) in blocks.iter().enumerate() {
            let end = u32::from(first) + u32::from(count);
            let key = place.key(&format!("registers.{name}"));
            if end > REGISTERS {
                let found = format!(
                    "is {first}; the block of {count} registers would end at register {}, which does not exist",
                    end - 1
                );
                document.report(&key, found, "the last register of a device is 65535", "lower it");
            }
            for &(other, start, length) in &blocks[..k] {
                if u32::from(start) < end && u32::from(first) < u32::from(start) + u32::from(length) {
                    // If only the earlier block was moved, the earlier block is the one to correct.
                    let moved = document.contains_key(&key);
                    let (key, of) =
                        if moved { (key.clone(), other) } else { (place.key(&format!("registers.{other}")), name) };
                    let found = format!("overlaps the block `{of}`");
                    let allowed = format!(
                        "`{other}` has registers {start} to {}, `{name}` has registers {first} to {}",
                        u32::from(start) + u32::from(length) - 1,
                        end - 1
                    );
                    document.report(&key, found, &allowed, "move one of them");
                }
            }
        }
    }
}

/// Coding of the value of a signal in its registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[expect(missing_docs, reason = "they say it")]
pub enum SignalType {
    U16,
    I16,
    U32,
    I32,
    F32,
    F64,
}

impl SignalType {
    /// Returns the number of registers of a value of this type.
    pub fn registers(self) -> u16 {
        match self {
            Self::U16 | Self::I16 => 1,
            Self::U32 | Self::I32 | Self::F32 => 2,
            Self::F64 => 4,
        }
    }
}

/// A further value, read only.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SignalTable {
    /// Name of the value.
    #[schemars(length(min = 1, max = 60), extend("x-required" = true), example = &"spindle_load")]
    pub name: Option<String>,
    /// Address of its first register, from 0.
    #[schemars(range(min = 0, max = 65535), extend("x-required" = true), example = 1000)]
    pub address: Option<u16>,
    /// Coding of the value.
    #[serde(rename = "type")]
    #[schemars(extend("x-required" = true), example = &"u16")]
    pub kind: Option<SignalType>,
    /// First word of the value. Default: `registers.word_order`.
    pub word_order: Option<WordOrder>,
    /// Factor by which the number is multiplied.
    pub scale: f64,
    /// Unit of the value after the multiplication.
    #[schemars(length(max = 20))]
    pub unit: String,
    /// Minimum and maximum plausible value.
    #[schemars(extend("x-required" = true), example = [0.0, 100.0])]
    pub range: Option<[f64; 2]>,
}

impl Default for SignalTable {
    fn default() -> Self {
        Self { name: None, address: None, kind: None, word_order: None, scale: 1.0, unit: String::new(), range: None }
    }
}

/// Additional signal that the cell file requests. It is read with every status and checked against its range.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Name of the signal.
    pub name: String,
    /// Address of its first register, from 0.
    pub address: u16,
    /// Type of the value in the registers.
    pub kind: SignalType,
    /// Word order of the value.
    pub word_order: WordOrder,
    /// Factor by which the value in the registers is multiplied.
    pub scale: f64,
    /// Unit of the product.
    pub unit: String,
    /// Minimum and maximum possible value.
    pub range: [f64; 2],
}

impl Signal {
    /// Converts the signals (additional values to read from a machine) of a cell file, and returns them. `written` are
    /// the tables of the signals in the file. A signal without its own word order gets `word_order`. `place` is the
    /// table of this machine in the file. It gives the full key for the messages.
    ///
    /// Reports to `document` each repeated name, each scale of 0, each range that is not ascending, and each address
    /// after the last register. Signals with these problems are contained in the result. Returns `None` if a required
    /// key of a signal is missing. The check against the schema has already reported the missing key.
    pub fn from_tables(
        written: &[SignalTable],
        word_order: WordOrder,
        place: &MachineTable<'_>,
        document: &mut Document,
    ) -> Option<Vec<Self>> {
        let mut signals = Vec::new();
        for (k, table) in written.iter().enumerate() {
            let key = |name: &str| place.key(&format!("signals[{k}].{name}"));
            if let Some(name) = &table.name
                && written[..k].iter().any(|other| other.name.as_ref() == Some(name))
            {
                let found = format!("is {name:?} again");
                document.report(&key("name"), found, "", "give each signal its own name");
            }
            if table.scale == 0.0 {
                document.report(
                    &key("scale"),
                    "is 0",
                    "every value would be 0",
                    "write 1 to use the number in the register unchanged",
                );
            }
            let Some(signal) = Self::from_table(table, word_order) else { continue };
            if signal.range[0] >= signal.range[1] {
                let found = format!("is [{}, {}]", signal.range[0], signal.range[1]);
                document.report(
                    &key("range"),
                    found,
                    "the first limit must be less than the second limit",
                    "swap them",
                );
            }
            let last = u32::from(signal.address) + u32::from(signal.kind.registers()) - 1;
            if last >= REGISTERS {
                let found = format!(
                    "is {}; the last register of the value would be {last}, which does not exist",
                    signal.address
                );
                document.report(&key("address"), found, "the last register of a device is 65535", "lower it");
            }
            signals.push(signal);
        }
        (signals.len() == written.len()).then_some(signals)
    }

    fn from_table(table: &SignalTable, word_order: WordOrder) -> Option<Self> {
        Some(Self {
            name: table.name.clone()?,
            address: table.address?,
            kind: table.kind?,
            word_order: table.word_order.unwrap_or(word_order),
            scale: table.scale,
            unit: table.unit.clone(),
            range: table.range?,
        })
    }
}

/// All settings of the driver of a machine on Modbus.
#[derive(Debug, Clone, PartialEq)]
pub struct ModbusSettings {
    /// Line of the machine.
    pub line: LineAddress,
    /// Unit number of the machine.
    pub unit: u8,
    /// Addresses of its blocks, and its word order.
    pub registers: RegisterMap,
    /// Timeout for an answer.
    pub request_timeout: Duration,
    /// Number of retries of a request.
    pub retries: u32,
    /// Time without an answer after which a request fails, independent of the number of retries.
    pub lost_after: Duration,
    /// Worst-case answer time of the machine. After an error the line is not used for this time.
    pub quarantine: Duration,
    /// Number of this client; not 0.
    pub owner: u32,
    /// Epoch of this client, which increases with each start. It is raised above the epoch that the machine has stored
    /// for this client.
    pub epoch: u32,
    /// Additional signals to read.
    pub signals: Vec<Signal>,
    /// Interval of the heartbeat. A machine regards its client as lost after 1.5 s without a heartbeat.
    pub heartbeat_interval: Duration,
    /// Name that the machine must report; `None` accepts any name.
    pub expected_name: Option<String>,
    /// True if the machine must be a simulation, false if it must not be one; `None` accepts both.
    pub simulation: Option<bool>,
}

impl ModbusSettings {
    /// Returns the default settings of the driver for a machine on the Modbus line `line`. The timeouts suit a network
    /// without disturbances. The unit number is 1, and there are no signals. Change single fields of the result as
    /// required.
    pub fn new(line: LineAddress) -> Self {
        Self {
            line,
            unit: 1,
            registers: RegisterMap::default(),
            request_timeout: Duration::from_millis(500),
            retries: 3,
            lost_after: Duration::from_secs(5),
            quarantine: Duration::from_millis(100),
            owner: 1,
            epoch: 1,
            signals: Vec::new(),
            heartbeat_interval: Duration::from_millis(250),
            expected_name: None,
            simulation: None,
        }
    }
}
