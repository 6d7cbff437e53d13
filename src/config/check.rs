//! From a cell file as written to a checked one: units, and what one key says against another.

use std::net::IpAddr;
use std::path::Path;
use std::time::Duration;

use super::written::{
    CellFile, ExchangeTable, FixtureTable, GrinderTable, LengthWord, RegistersTable, SignalTable, SphereTable,
    TimingTable, TravelTable, WireTable,
};
use super::{
    CellConfig, Cmm, Content, FileExchange, Grinder, GrinderLimits, Link, ReferenceSphere, RegisterMap, Signal,
    Station, Timing, Travel, Wire, WordOrder,
};
use crate::document::Document;
use crate::geometry::{Point, Pose, Twist};

/// Registers that a Modbus device can have.
const REGISTERS: u32 = 1 << 16;

/// Everything of a cell but where it came from; `None` where something is missing, which has been told.
pub(super) struct Checked {
    name: Option<String>,
    simulated: Option<bool>,
    cmm: Option<Cmm>,
    grinder: Option<Grinder>,
}

impl Checked {
    /// Puts the cell together, if nothing is missing.
    pub(super) fn into_cell(self, path: &Path, text: &str, source_sha256: [u8; 32]) -> Option<CellConfig> {
        Some(CellConfig {
            name: self.name?,
            simulated: self.simulated?,
            cmm: self.cmm?,
            grinder: self.grinder?,
            path: path.to_owned(),
            text: text.to_owned(),
            source_sha256,
        })
    }
}

/// The tables that both machines have.
struct Machine<'w> {
    key: &'static str,
    wire: Option<&'w WireTable>,
    expected_name: Option<&'w String>,
    timing: &'w TimingTable,
    registers: Option<&'w RegistersTable>,
    signals: &'w [SignalTable],
}

/// Checks a cell file as written; what is wrong is told to the document.
pub(super) fn check(written: &CellFile, path: &Path, document: &mut Document) -> Checked {
    let folder = path.parent().unwrap_or(Path::new(""));
    let (cmm, grinder) = (&written.cmm, &written.grinder);
    let machines = [
        Machine {
            key: "cmm",
            wire: cmm.wire.as_ref(),
            expected_name: cmm.expected_name.as_ref(),
            timing: &cmm.timing,
            registers: cmm.registers.as_ref(),
            signals: &cmm.signals,
        },
        Machine {
            key: "grinder",
            wire: grinder.wire.as_ref(),
            expected_name: grinder.expected_name.as_ref(),
            timing: &grinder.timing,
            registers: grinder.registers.as_ref(),
            signals: &grinder.signals,
        },
    ];
    let simulated = written.cell.simulated;
    // One machine by files beside a simulated one is a rehearsal; both by files leave nothing to be simulated.
    if simulated == Some(true) && machines.iter().all(|m| matches!(m.wire, Some(WireTable::FileExchange(_)))) {
        let found = "is true, and both machines are reached by files";
        document.report("cell.simulated", found, "nobody simulates a person with files", "write `simulated = false`");
    }
    let [cmm_link, grinder_link] = machines.map(|machine| machine.link(simulated, folder, document));
    compare_wires(cmm_link.as_ref(), grinder_link.as_ref(), document);
    let sphere = cmm.reference_sphere.as_ref().map(|sphere| reference_sphere(sphere, cmm.travel.as_ref(), document));
    let travel = cmm.travel.as_ref().map(|travel| self::travel(travel, "cmm", document));
    let limits = limits(grinder, document);
    // A table that is there and incomplete has been told of.
    let complete = !matches!(sphere, Some(None)) && !matches!(travel, Some(None));
    Checked {
        name: written.cell.name.clone(),
        simulated,
        cmm: cmm_link.filter(|_| complete).map(|link| Cmm {
            link,
            fixture_cmm_from_model: fixture(&cmm.fixture),
            reference_sphere: sphere.flatten(),
            travel: travel.flatten(),
        }),
        grinder: grinder_link.zip(limits).map(|(link, limits)| Grinder { link, limits }),
    }
}

impl Machine<'_> {
    fn key(&self, rest: &str) -> String {
        format!("{}.{rest}", self.key)
    }

    fn link(&self, simulated: Option<bool>, folder: &Path, document: &mut Document) -> Option<Link> {
        let timing = self.timing(document);
        let registers = self.registers.map_or(RegisterMap::default(), RegisterMap::from);
        self.check_blocks(&registers, document);
        let signals = self.signals(registers.word_order, document);
        let wire = self.wire(simulated, folder, document);
        if matches!(wire, Some(Wire::FileExchange(_))) {
            let idle = [("registers", self.registers.is_some()), ("signals", !self.signals.is_empty())];
            for (table, _) in idle.iter().filter(|(_, there)| *there) {
                let found = "stands beside a wire of files";
                document.report(&self.key(table), found, "files have no registers", "leave it out, or change the wire");
            }
        }
        Some(Link { wire: wire?, timing, registers, signals: signals?, expected_name: self.expected_name.cloned() })
    }

    fn timing(&self, document: &mut Document) -> Timing {
        let written = self.timing;
        let all_tries_ms = written.request_timeout_ms * (u64::from(written.retries) + 1);
        if all_tries_ms > written.lost_after_ms {
            document.report(
                &self.key("timing.lost_after_ms"),
                format!(
                    "is {} ms; {} tries of {} ms take {all_tries_ms} ms",
                    written.lost_after_ms,
                    u64::from(written.retries) + 1,
                    written.request_timeout_ms
                ),
                "a machine cannot be lost before every try has failed",
                "raise it, or lower `request_timeout_ms` or `retries`",
            );
        }
        for (name, ms) in [("poll_ms", written.poll_ms), ("heartbeat_ms", written.heartbeat_ms)] {
            if 2 * ms > written.lost_after_ms {
                document.report(
                    &self.key(&format!("timing.{name}")),
                    format!("is {ms} ms, more than half of `lost_after_ms`, {} ms", written.lost_after_ms),
                    "one that comes late must not mean that the machine is lost",
                    "lower it, or raise `lost_after_ms`",
                );
            }
        }
        let ms = Duration::from_millis;
        Timing {
            request_timeout: ms(written.request_timeout_ms),
            retries: written.retries,
            poll: ms(written.poll_ms),
            heartbeat: ms(written.heartbeat_ms),
            lost_after: ms(written.lost_after_ms),
            quarantine: ms(written.quarantine_ms),
        }
    }

    fn check_blocks(&self, registers: &RegisterMap, document: &mut Document) {
        let blocks = registers.blocks();
        for (k, &(name, first, count)) in blocks.iter().enumerate() {
            let end = u32::from(first) + u32::from(count);
            let key = self.key(&format!("registers.{name}"));
            if end > REGISTERS {
                let found = format!("is {first}; the block has {count} registers and would end at {}", end - 1);
                document.report(&key, found, "the last register of a device is 65535", "lower it");
            }
            for &(other, start, length) in &blocks[..k] {
                if u32::from(start) < end && u32::from(first) < u32::from(start) + u32::from(length) {
                    // Where only the earlier block was moved, that is the one to correct.
                    let moved = document.is_there(&key);
                    let (key, of) =
                        if moved { (key.clone(), other) } else { (self.key(&format!("registers.{other}")), name) };
                    let found = format!("overlaps the block `{of}`");
                    let allowed = format!(
                        "`{other}` is {start} to {}, `{name}` is {first} to {}",
                        u32::from(start) + u32::from(length) - 1,
                        end - 1
                    );
                    document.report(&key, found, &allowed, "move one of them");
                }
            }
        }
    }

    fn signals(&self, word_order: WordOrder, document: &mut Document) -> Option<Vec<Signal>> {
        let mut signals = Vec::new();
        for (k, written) in self.signals.iter().enumerate() {
            let key = |name: &str| self.key(&format!("signals[{k}].{name}"));
            if let Some(name) = &written.name
                && self.signals[..k].iter().any(|other| other.name.as_ref() == Some(name))
            {
                document.report(
                    &key("name"),
                    format!("is {name:?} a second time"),
                    "",
                    "give every signal its own name",
                );
            }
            if written.scale == 0.0 {
                document.report(&key("scale"), "is 0", "every value would be 0", "1 leaves the number as it is");
            }
            let Some(signal) = signal(written, word_order) else { continue };
            if signal.range[0] >= signal.range[1] {
                let found = format!("is [{}, {}]", signal.range[0], signal.range[1]);
                document.report(&key("range"), found, "the first must be less than the second", "interchange them");
            }
            let last = u32::from(signal.address) + u32::from(signal.kind.registers()) - 1;
            if last >= REGISTERS {
                let found = format!("is {}; the value would end at {last}", signal.address);
                document.report(&key("address"), found, "the last register of a device is 65535", "lower it");
            }
            signals.push(signal);
        }
        (signals.len() == self.signals.len()).then_some(signals)
    }

    fn wire(&self, simulated: Option<bool>, folder: &Path, document: &mut Document) -> Option<Wire> {
        match self.wire? {
            WireTable::ModbusTcp(tcp) => {
                let host = tcp.host.clone()?;
                self.check_tcp(&host, tcp.port, simulated, document);
                Some(Wire::ModbusTcp { host, port: tcp.port, unit: tcp.unit })
            }
            WireTable::ModbusRtu(rtu) => Some(Wire::ModbusRtu {
                device: rtu.device.clone()?,
                baud: rtu.baud,
                parity: rtu.parity,
                stop_bits: rtu.stop_bits,
                unit: rtu.unit,
            }),
            WireTable::FileExchange(files) => self.files(files, folder, document).map(Wire::FileExchange),
        }
    }

    fn check_tcp(&self, host: &str, port: u16, simulated: Option<bool>, document: &mut Document) {
        let is_here = host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback());
        if host.chars().any(|c| c.is_whitespace() || c == '/' || c == '@') {
            let allowed = "it must be a name or an address alone, such as \"192.168.0.10\"";
            document.report(&self.key("wire.host"), format!("is {host:?}"), allowed, "the port has a key of its own");
        } else if simulated == Some(true) && !is_here {
            document.report(
                &self.key("wire.host"),
                format!("is {host:?} in a simulated cell"),
                "simulated machines are on this computer: 127.0.0.1, ::1 or localhost",
                "is the machine real? then write `simulated = false`",
            );
        }
        if port == 0 && simulated == Some(false) {
            document.report(
                &self.key("wire.port"),
                "is 0 in a cell that is not simulated",
                "it must be a whole number from 1 to 65535",
                "502 is usual for Modbus TCP",
            );
        }
    }

    fn files(&self, written: &ExchangeTable, folder: &Path, document: &mut Document) -> Option<FileExchange> {
        let (outbox, inbox) = (folder.join(written.outbox.as_ref()?), folder.join(written.inbox.as_ref()?));
        if outbox == inbox {
            let allowed = "what is written and what is awaited must be told apart";
            document.report(&self.key("wire.inbox"), "is the same folder as `outbox`", allowed, "give each a folder");
        }
        self.check_result(&written.result, document);
        self.check_stations(written, document);
        let stations = written
            .stations
            .iter()
            .map(|station| Some(Station { points: station.points.clone()?, reference: station.reference.clone()? }));
        Some(FileExchange {
            outbox,
            inbox,
            stable_for: Duration::from_secs_f64(written.stable_for_s),
            content: Content {
                what: written.what,
                decimal: written.decimal,
                unit_mm: match written.unit {
                    LengthWord::Mm => 1.0,
                    LengthWord::Inch => 25.4,
                },
            },
            stations: stations.collect::<Option<Vec<Station>>>()?,
            reference_points: written.reference_points.as_ref().map(|file| folder.join(file)),
            reference_group: written.reference_group.clone(),
            reference_limit_mm: written.reference_limit_mm,
            result: written.result.clone(),
            take_earlier: written.take_earlier,
            probe_tolerance_mm: written.probe_tolerance_mm,
        })
    }

    fn check_result(&self, name: &str, document: &mut Document) {
        let mut plain = name.to_owned();
        for word in ["{part}", "{job}", "{cycle}"] {
            plain = plain.replace(word, "");
        }
        if plain.contains(['/', '\\', '{', '}']) || plain.matches('*').count() > 1 {
            let allowed =
                "it must be the name of a file in the inbox, with `{part}`, `{job}`, `{cycle}` and one `*` at most";
            document.report(
                &self.key("wire.result"),
                format!("is {name:?}"),
                allowed,
                "\"{part}_c{cycle}.*\" is usual",
            );
        }
    }

    fn check_stations(&self, written: &ExchangeTable, document: &mut Document) {
        let reference = "wire.reference_points";
        match (written.stations.is_empty(), written.reference_points.is_some()) {
            (false, false) if !document.has_problem(&self.key(reference)) => {
                let allowed = "stations are merged by reference points";
                document.report(&self.key("wire.stations"), "have no `reference_points`", allowed, "name their file");
            }
            (true, true) if !document.has_problem(&self.key("wire.stations")) => {
                let allowed = "they merge stations, and there is none";
                document.report(
                    &self.key(reference),
                    "is given without stations",
                    allowed,
                    "add [[cmm.wire.stations]]",
                );
            }
            _ => {}
        }
        for (k, station) in written.stations.iter().enumerate() {
            let (Some(points), Some(other)) = (&station.points, &station.reference) else { continue };
            let stars = [points, other].map(|name| name.matches('*').count());
            for (name, key) in [(points, "points"), (other, "reference")] {
                let key = self.key(&format!("wire.stations[{k}].{key}"));
                if name.contains(['/', '\\']) || name.matches('*').count() > 1 {
                    let allowed = "it must be the name of a file in the inbox, with one `*` at most";
                    document.report(&key, format!("is {name:?}"), allowed, "leave the folder out");
                }
            }
            if stars[0] != stars[1] && stars[0].max(stars[1]) == 1 {
                let key = self.key(&format!("wire.stations[{k}].reference"));
                let allowed = "`*` must stand in both names or in none";
                document.report(&key, format!("is {other:?} where `points` is {points:?}"), allowed, "add the `*`");
            }
        }
    }
}

fn signal(written: &SignalTable, word_order: WordOrder) -> Option<Signal> {
    Some(Signal {
        name: written.name.clone()?,
        address: written.address?,
        kind: written.kind?,
        word_order: written.word_order.unwrap_or(word_order),
        scale: written.scale,
        unit: written.unit.clone(),
        range: written.range?,
    })
}

/// Two machines must not be one, and one line has one speed.
fn compare_wires(cmm: Option<&Link>, grinder: Option<&Link>, document: &mut Document) {
    let (Some(cmm), Some(grinder)) = (cmm, grinder) else { return };
    match (&cmm.wire, &grinder.wire) {
        (Wire::ModbusTcp { host: a, port: p, unit: u }, Wire::ModbusTcp { host: b, port: q, unit: v })
            if a == b && p == q && *p != 0 && u == v =>
        {
            let found = format!("is {v}, as that of the CMM at the same host and port");
            document.report(
                "grinder.wire.unit",
                found,
                "two machines need two units or two ports",
                "correct one of them",
            );
        }
        (
            Wire::ModbusRtu { device: a, baud, parity, stop_bits, unit: u },
            Wire::ModbusRtu { device: b, baud: baud_2, parity: parity_2, stop_bits: stop_bits_2, unit: v },
        ) if a == b => {
            if u == v {
                let found = format!("is {v}, as that of the CMM on the same line");
                document.report(
                    "grinder.wire.unit",
                    found,
                    "two machines on one line need two units",
                    "correct one of them",
                );
            }
            if (baud, parity, stop_bits) != (baud_2, parity_2, stop_bits_2) {
                let found = "has another speed, parity or stop bits than the CMM on the same line";
                document.report("grinder.wire", found, "a line has one setting", "make them the same");
            }
        }
        (Wire::FileExchange(a), Wire::FileExchange(b)) if a.inbox == b.inbox => {
            let allowed = "a result must be told to one machine";
            document.report("grinder.wire.inbox", "is the inbox of the CMM too", allowed, "give each machine its own");
        }
        _ => {}
    }
}

/// Turns about fixed x, then y, then z, then moves.
fn fixture(written: &FixtureTable) -> Pose {
    let turn = |axis: usize| {
        let mut twist = Twist::zeros();
        twist[3 + axis] = written.rotation_deg[axis].to_radians();
        Pose::exp(&twist).rotation
    };
    Pose { rotation: turn(2) * turn(1) * turn(0), translation_mm: written.translation_mm.into() }.orthonormalised()
}

fn reference_sphere(
    written: &SphereTable,
    travel: Option<&TravelTable>,
    document: &mut Document,
) -> Option<ReferenceSphere> {
    let (centre_mm, radius_mm) = (written.centre_mm?, written.radius_mm?);
    if let Some((least, most)) = travel.and_then(|travel| travel.least_mm.zip(travel.most_mm))
        && (0..3).all(|k| least[k] < most[k])
        && (0..3).any(|k| !(least[k]..=most[k]).contains(&centre_mm[k]))
    {
        let [x, y, z] = centre_mm;
        let found = format!("is [{x}, {y}, {z}], outside [cmm.travel]");
        document.report(
            "cmm.reference_sphere.centre_mm",
            found,
            "the probe must reach the sphere",
            "correct one of them",
        );
    }
    Some(ReferenceSphere { centre: Point::from(centre_mm), radius_mm, points: written.points })
}

fn travel(written: &TravelTable, machine: &str, document: &mut Document) -> Option<Travel> {
    let (least_mm, most_mm) = (written.least_mm?, written.most_mm?);
    for (k, axis) in ["x", "y", "z"].into_iter().enumerate() {
        if least_mm[k] >= most_mm[k] {
            let found = format!("is {} in {axis}, `most_mm` is {}", least_mm[k], most_mm[k]);
            document.report(
                &format!("{machine}.travel.least_mm"),
                found,
                "it must be less",
                "are the two interchanged?",
            );
        }
    }
    Some(Travel { least_mm, most_mm })
}

fn limits(grinder: &GrinderTable, document: &mut Document) -> Option<GrinderLimits> {
    let written = &grinder.limits;
    let wheel_radius_mm = [written.least_wheel_radius_mm?, written.largest_wheel_radius_mm?];
    if wheel_radius_mm[0] > wheel_radius_mm[1] {
        document.report(
            "grinder.limits.least_wheel_radius_mm",
            format!("is {} mm, more than `largest_wheel_radius_mm`, {} mm", wheel_radius_mm[0], wheel_radius_mm[1]),
            "no wheel would fit",
            "are the two interchanged?",
        );
    }
    Some(GrinderLimits {
        largest_feed_mm_min: written.largest_feed_mm_min?,
        wheel_radius_mm,
        largest_depth_mm: written.largest_depth_mm?,
        largest_speed_mm_s: written.largest_speed_mm_s,
        largest_acceleration_mm_s2: written.largest_acceleration_mm_s2,
        travel: grinder.travel.as_ref().and_then(|travel| self::travel(travel, "grinder", document)),
    })
}
