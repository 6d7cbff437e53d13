//! Table of the cell file for a CMM that prints its hits, and its driver factory.

use std::time::Duration;

use regrind_document::Document;
use regrind_formats::Unit;
use regrind_formats::result::Coordinates;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::link::HitSource;
use super::machine::HitLinesCmm;
use super::protocol::{LineFormat, LineParser, Separator};
use super::settings::HitLinesSettings;
use super::target_list::Repeated;
use crate::driver_factory::{ConnectionCheck, DriverContext, DriverError, DriverFactory};
use crate::machine_table::MachineTable;
use crate::modbus::{Parity, serial_port};
use crate::no_machine::NoMachine;

/// Device name in a simulated cell for a pseudo-terminal that is created at the start.
pub(super) const AUTO: &str = "auto";

/// A line for each hit, from a measuring machine or an arm that accepts no commands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct HitLinesWire {
    /// Name of the serial port in the operating system; omit it if `host` names a terminal server. In a simulated cell
    /// "auto" creates a port.
    #[schemars(length(min = 1, max = 400), example = &"/dev/ttyUSB0")]
    pub device: Option<String>,
    /// Bits per second.
    #[schemars(range(min = 300, max = 4000000))]
    pub baud: u32,
    /// Data bits.
    pub data_bits: DataBits,
    /// Parity.
    pub parity: Parity,
    /// Stop bits.
    #[schemars(range(min = 1, max = 2))]
    pub stop_bits: u8,
    /// Name or address of a terminal server; omit it if `device` names a serial port.
    #[schemars(length(min = 1, max = 253), example = &"192.168.0.30")]
    pub host: Option<String>,
    /// Port of the terminal server.
    #[schemars(range(min = 0, max = 65535))]
    pub port: u16,
    /// Format of a hit.
    #[schemars(extend("x-required" = true), example = &"decimal")]
    pub format: Option<LineFormat>,
    /// Meaning of the coordinates: centres of the probe, or contacts.
    #[schemars(extend("x-required" = true), example = &"centres")]
    pub coordinates: Option<Coordinates>,
    /// Number of digits after the decimal mark of each coordinate; a line with another number is refused.
    #[schemars(range(min = 1, max = 9))]
    pub decimals: u8,
    /// Decimal mark.
    pub decimal: Mark,
    /// Separator between two values.
    pub separator: Separator,
    /// Unit of coordinates with a decimal mark; whole numbers are micrometres.
    pub unit: Unit,
    /// Axes of the machine for the first, second and third value.
    pub axes: Axes,
    /// Required angle of a rotary table, as the line reports it.
    #[schemars(range(min = -36000.0, max = 36000.0))]
    pub rotary_deg: f64,
    /// Tolerance of the angle of the rotary table.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub rotary_tolerance_deg: f64,
    /// Maximum distance of a point from its target. A point belongs to the nearest target, and is refused if all
    /// targets are farther away.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub limit_mm: f64,
    /// Time within which an identical line is the same touch, sent twice.
    #[schemars(range(min = 0, max = 10000))]
    pub duplicate_window_ms: u32,
    /// Handling of a second touch of a target.
    pub repeated_touch: Repeated,
    /// Timeout of the rest of a line that has begun.
    #[schemars(range(min = 10, max = 60000))]
    pub line_timeout_ms: u32,
    /// Beginnings of lines to ignore, such as headers.
    #[schemars(length(max = 32), inner(length(min = 1, max = 80)))]
    pub ignored_prefixes: Vec<String>,
    /// Time after the last point at which the probe is clear of the part, if the machine's own part program moves it
    /// clear. Default: a person is asked.
    #[schemars(range(min = 0.1, max = 3600.0))]
    pub clear_after_s: Option<f64>,
    /// Folder into which Regrind writes the list of targets, `plan.csv`, at the start of a measurement, for a part
    /// program; relative to this file.
    #[schemars(length(min = 1, max = 400))]
    pub plan_folder: Option<String>,
}

/// Data bits of a serial line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[expect(missing_docs, reason = "the names say it")]
pub enum DataBits {
    Seven,
    #[default]
    Eight,
}

/// A decimal mark.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[expect(missing_docs, reason = "the names say it")]
pub enum Mark {
    #[default]
    Point,
    Comma,
}

/// Axes of the three values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[expect(missing_docs, reason = "the names say it")]
pub enum Axes {
    #[default]
    Xyz,
    Xzy,
    Yxz,
    Yzx,
    Zxy,
    Zyx,
}

impl Axes {
    fn order(self) -> [usize; 3] {
        match self {
            Self::Xyz => [0, 1, 2],
            Self::Xzy => [0, 2, 1],
            Self::Yxz => [1, 0, 2],
            Self::Yzx => [1, 2, 0],
            Self::Zxy => [2, 0, 1],
            Self::Zyx => [2, 1, 0],
        }
    }
}

impl Default for HitLinesWire {
    fn default() -> Self {
        Self {
            device: None,
            baud: 9600,
            data_bits: DataBits::Eight,
            parity: Parity::Even,
            stop_bits: 1,
            host: None,
            port: 0,
            format: None,
            coordinates: None,
            decimals: 3,
            decimal: Mark::Point,
            separator: Separator::Comma,
            unit: Unit::Millimetre,
            axes: Axes::Xyz,
            rotary_deg: 0.0,
            rotary_tolerance_deg: 0.05,
            limit_mm: 1.0,
            duplicate_window_ms: 200,
            repeated_touch: Repeated::Refuse,
            line_timeout_ms: 1000,
            ignored_prefixes: Vec::new(),
            clear_after_s: None,
            plan_folder: None,
        }
    }
}

impl DriverFactory for HitLinesWire {
    type Cmm = HitLinesCmm;
    type Grinder = NoMachine;
    const BY_PERSON: bool = true;
    const REPORTS_TEMPERATURE: bool = false;
    const CHECK: ConnectionCheck = ConnectionCheck::Listen;

    fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
        if place.table == "grinder" {
            let allowed = "hit lines are for measuring machines";
            return document.report("grinder.wire.kind", "is \"hit-lines\"", allowed, "name another wire");
        }
        self.check_line(place, document);
        self.check_format(document);
    }

    fn notes(&self) -> Vec<String> {
        self.missing().into_iter().collect()
    }

    fn coordinates(&self) -> Option<Coordinates> {
        self.coordinates
    }

    fn create_cmm(&self, context: &DriverContext<'_>) -> Result<HitLinesCmm, DriverError> {
        if let Some(missing) = self.missing() {
            return Err(DriverError::NoPort { missing });
        }
        let plan_folder = self.plan_folder.as_ref().map(|folder| context.cell_folder.join(folder));
        if let Some(path) = plan_folder.as_ref().filter(|path| !path.is_dir()) {
            let machine = crate::MachineKind::Cmm;
            return Err(DriverError::Folder { key: "cmm.wire.plan_folder".to_owned(), path: path.clone(), machine });
        }
        let ms = |ms: u32| Duration::from_millis(ms.into());
        Ok(HitLinesCmm::new(HitLinesSettings {
            part: context.part.to_owned(),
            run_folder: context.run_folder.to_owned(),
            plan_folder,
            source: self.source(),
            parser: self.parser(),
            // A cell file without this key is refused.
            coordinates: self.coordinates.unwrap_or(Coordinates::Centres),
            rotary_deg: [self.rotary_deg, self.rotary_tolerance_deg],
            limit_mm: self.limit_mm,
            duplicate_window: ms(self.duplicate_window_ms),
            repeated: self.repeated_touch,
            line_timeout: ms(self.line_timeout_ms),
            ignored_prefixes: self.ignored_prefixes.clone(),
            clear_after: self.clear_after_s.map(Duration::from_secs_f64),
            min_free_points: context.min_free_points,
            connect_timeout: context.timing.lost_after,
            silence: context.timing.quarantine,
            simulated: context.simulated,
        }))
    }

    fn create_grinder(&self, _: &DriverContext<'_>) -> Result<NoMachine, DriverError> {
        Err(DriverError::NoDriver { table: "grinder", kind: "hit-lines" })
    }

    fn address(&self) -> Option<String> {
        Some(self.source().to_string())
    }

    fn has_open_address(&self) -> bool {
        match self.source() {
            HitSource::Serial { device, .. } => device == AUTO,
            HitSource::Tcp { port, .. } => port == 0,
        }
    }
}

impl HitLinesWire {
    /// Returns where the lines come from: a serial line or a TCP address.
    fn source(&self) -> HitSource {
        let Self { device, host, port, .. } = self.clone();
        match (device, host) {
            (Some(device), _) => HitSource::Serial {
                device,
                baud: self.baud,
                data_bits: if self.data_bits == DataBits::Seven { 7 } else { 8 },
                parity: self.parity,
                stop_bits: self.stop_bits,
            },
            (None, host) => HitSource::Tcp { host: host.unwrap_or_default(), port },
        }
    }

    /// Returns the parser of the lines, with the format that the cell file states.
    fn parser(&self) -> LineParser {
        LineParser {
            // A cell file without this key is refused.
            format: self.format.unwrap_or(LineFormat::Decimal),
            separator: self.separator,
            mark: if self.decimal == Mark::Comma { ',' } else { '.' },
            decimals: usize::from(self.decimals),
            unit_mm: self.unit.in_mm(),
            axes: self.axes.order(),
        }
    }

    fn missing(&self) -> Option<String> {
        let device = self.device.as_ref().filter(|device| *device != AUTO)?;
        serial_port::missing(device)
    }

    fn check_line(&self, place: &MachineTable<'_>, document: &mut Document) {
        let one = "the lines come either from a serial port (`device`) or from a terminal server (`host`)";
        match (&self.device, &self.host) {
            (None, None) => {
                document.report(&place.key("wire.device"), "is missing, and so is `host`", one, "name one of them");
            }
            (Some(_), Some(_)) => {
                document.report(&place.key("wire.host"), "is given together with `device`", one, "remove one of them");
            }
            (Some(device), None) if device == AUTO && place.simulated == Some(false) => {
                let allowed = "only a simulated cell creates a port itself";
                document.report(&place.key("wire.device"), "is \"auto\" in a real cell", allowed, "name the port");
            }
            (None, Some(_)) if self.port == 0 && place.simulated == Some(false) => {
                let found = "is 0 in a cell that is not simulated";
                let allowed = "the port must be a whole number from 1 to 65535";
                document.report(
                    &place.key("wire.port"),
                    found,
                    allowed,
                    "write the port number from the settings of the terminal server",
                );
            }
            _ => {}
        }
    }

    fn check_format(&self, document: &mut Document) {
        let Some(format) = self.format else { return };
        if format.is_integer() && self.unit == Unit::Inch {
            let found = "is inch, but a format of whole numbers cannot have inches";
            let allowed = "whole numbers are always in µm";
            document.report("cmm.wire.unit", found, allowed, "remove this key, or set the machine to print decimals");
        }
        if self.decimal == Mark::Comma && self.separator == Separator::Comma && !format.is_integer() {
            let found = "is \"comma\", but the separator between two values is a comma too";
            let allowed = "one mark cannot be both";
            document.report("cmm.wire.decimal", found, allowed, "set `separator` to the mark between two values");
        }
        if format.is_lettered() && self.axes != Axes::Xyz {
            let found = "is given, but the format already has a letter for the axis of each value";
            document.report("cmm.wire.axes", found, "only a format without letters allows this key", "remove this key");
        }
    }
}
