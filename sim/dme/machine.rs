//! Machine behind the server: tools, frames, parameters within their limits, motion within the volume, and touches of
//! the true part.

use std::collections::VecDeque;

use super::event::MachineEvent;
use super::line::{Argument, Command, DmeError};
use crate::Vec3;
use crate::cmm::{TouchProbe, TouchResult};
use crate::probe::Placement;
use crate::vector::{distance, length};

/// Options of the server and its machine.
#[derive(Clone, Debug)]
pub struct Options {
    /// Names of the tools, each with the radius that the machine assumes, in mm; `NoTool` has none.
    pub tools: Vec<(String, f64)>,
    /// Class that the machine reports.
    pub class: String,
    /// Version of the standard that the machine reports.
    pub version: String,
    /// True if the machine is homed before the client connects.
    pub homed: bool,
    /// Maximum speeds of travel and of a touch, in mm/s.
    pub max_speeds_mm_s: [f64; 2],
}

impl Default for Options {
    fn default() -> Self {
        Self {
            tools: vec![("NoTool".into(), 0.0), ("Probe1".into(), 1.5)],
            class: "CartCMM_Simulated".into(),
            version: "1.4".into(),
            homed: false,
            max_speeds_mm_s: [1000.0, 50.0],
        }
    }
}

/// Result of a command, and its duration.
#[derive(Clone, Debug, Default)]
pub struct CommandResult {
    /// Duration in the machine's time, in s.
    pub seconds: f64,
    /// Lines of data, each as its fields.
    pub data: Vec<Vec<String>>,
    /// Warnings, which stop nothing.
    pub warnings: Vec<DmeError>,
    /// Lines that are sent while the machine moves.
    pub(super) scanned: VecDeque<super::line::Scanned>,
    /// Touch that the command made.
    pub(super) touched: Option<MachineEvent>,
}

impl CommandResult {
    pub(super) fn with_data(fields: Vec<String>) -> Self {
        Self { data: vec![fields], ..Self::default() }
    }
}

/// Parameters of a tool: speed of travel; speed, approach, search and retract of a touch; speed and retract of a scan.
const PARAMETERS: [&str; 7] = [
    "GoToPar.Speed",
    "PtMeasPar.Speed",
    "PtMeasPar.Approach",
    "PtMeasPar.Search",
    "PtMeasPar.Retract",
    "ScanPar.Speed",
    "ScanPar.Retract",
];

const FIRST_PARAMETERS: [f64; 7] = [50.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0];

/// Creates the placement of the machine's frame in a frame that is written as six numbers. The first three are x, y, z
/// of the machine's origin in this frame, in mm. The last three are the Euler angles theta, psi, phi in degrees. The
/// matrix Rz(phi) Rx(theta) Rz(psi) rotates a direction from the machine's frame to this frame.
fn frame([x, y, z, theta, psi, phi]: [f64; 6]) -> Placement {
    let about_z = |deg: f64| {
        let (s, c) = deg.to_radians().sin_cos();
        [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    };
    let (s, c) = theta.to_radians().sin_cos();
    let about_x = [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]];
    let rotation = times(times(about_z(phi), about_x), about_z(psi));
    Placement { rotation, translation_mm: [x, y, z] }
}

fn times(a: [Vec3; 3], b: [Vec3; 3]) -> [Vec3; 3] {
    a.map(|row| std::array::from_fn(|k| (0..3).map(|i| row[i] * b[i][k]).sum()))
}

/// Frame of a part that is the machine's frame.
const MACHINE_FRAME: ([f64; 6], Placement) = ([0.0; 6], Placement::IDENTITY);

/// Simulated machine.
pub struct DmeMachine {
    options: Options,
    pub(super) probe: TouchProbe,
    homed: bool,
    tool: String,
    pub(super) parameters: [f64; 7],
    /// Frame of the part as it was written, and the placement of the machine's frame in it.
    part_frame: ([f64; 6], Placement),
    in_part_frame: bool,
    report: Vec<String>,
    pub(super) scan_report: Vec<String>,
    pub(super) at_nominals: bool,
    pub(super) can_scan: bool,
    reports_radius: bool,
    pub(super) contacts: u32,
    pub(super) touched_mm: Option<f64>,
    /// Position of the probe's centre in the machine's frame. `to_mm` is the position to which it moves.
    at_mm: Vec3,
    to_mm: Vec3,
    joystick: bool,
    /// Command that is being carried out. `events` are the events that it has caused.
    current_command: String,
    pub(super) events: Vec<MachineEvent>,
}

/// Returns true if the command with this name moves the machine.
pub(super) fn moves(command: &str) -> bool {
    matches!(command, "GoTo" | "PtMeas" | "ScanOnCurve" | "ChangeTool" | "Home")
}

impl DmeMachine {
    /// Creates a machine with its probe at the top of the travel, over the middle of the table.
    pub fn new(probe: TouchProbe, options: Options) -> Self {
        let [least, most] = probe.volume_mm();
        let at_mm = [0.5 * (least[0] + most[0]), 0.5 * (least[1] + most[1]), most[2]];
        Self {
            homed: options.homed,
            options,
            probe,
            tool: "NoTool".into(),
            parameters: FIRST_PARAMETERS,
            part_frame: MACHINE_FRAME,
            in_part_frame: false,
            report: Vec::new(),
            scan_report: Vec::new(),
            at_nominals: false,
            can_scan: true,
            reports_radius: true,
            contacts: 0,
            touched_mm: None,
            at_mm,
            to_mm: at_mm,
            joystick: true,
            current_command: String::new(),
            events: Vec::new(),
        }
    }

    /// Returns the position of the probe's centre, in the machine's frame.
    pub fn at_mm(&self) -> Vec3 {
        self.at_mm
    }

    /// Makes the probe a touch-trigger probe, which cannot scan.
    pub fn disable_scanning(&mut self) {
        self.can_scan = false;
    }

    /// Makes the server refuse queries of the tool's radius from now on, with error 510 (bad property).
    pub fn hide_radius(&mut self) {
        self.reports_radius = false;
    }

    /// Returns the number of touches and scans so far. A scan counts once.
    pub fn contacts(&self) -> u32 {
        self.contacts
    }

    /// Moves the probe to the top of its travel, as a person at the machine would.
    pub fn lift(&mut self) {
        self.at_mm[2] = self.probe.volume_mm()[1][2];
        self.to_mm = self.at_mm;
        self.stop_short(1.0);
    }

    pub(super) fn begin_session(&mut self) {
        self.report = ["X", "Y", "Z"].map(str::to_owned).to_vec();
        self.scan_report = ["X", "Y", "Z", "Q"].map(str::to_owned).to_vec();
        self.at_nominals = false;
    }

    /// Makes the probe ready to touch again after the client has cleared the errors. Does nothing, because the
    /// simulated probe is always ready.
    pub(super) fn arm(&mut self) {}

    /// Resets the machine as after power-on. The machine must be homed again. No tool is selected, the parameters have
    /// their first values, and the part frame equals the machine's frame.
    pub(super) fn restart(&mut self) {
        self.homed = false;
        self.tool = "NoTool".into();
        self.parameters = FIRST_PARAMETERS;
        (self.part_frame, self.in_part_frame, self.joystick) = (MACHINE_FRAME, false, true);
    }

    /// Moves the probe to the target position of its current motion, and ends the motion.
    pub(super) fn arrive(&mut self) {
        self.stop_short(1.0);
    }

    /// Sets the position of the probe's centre during a scan, in the machine's frame.
    pub(super) fn set_position(&mut self, at_mm: Vec3) {
        self.at_mm = at_mm;
    }

    /// Ends the current motion after the fraction `share` of its path, from 0 (start) to 1 (end). Also releases the
    /// part in two cases:
    ///
    /// - The probe has not touched anything since the part was last released.
    /// - The end position is higher (in z) than the last contact by more than twice the approach distance.
    pub(super) fn stop_short(&mut self, share: f64) {
        self.at_mm = std::array::from_fn(|k| self.at_mm[k] + share * (self.to_mm[k] - self.at_mm[k]));
        self.to_mm = self.at_mm;
        // High enough above the contact, the probe releases the part.
        if self.touched_mm.is_none_or(|height| self.at_mm[2] > height + 2.0 * self.parameters[2]) {
            self.touched_mm = None;
            self.probe.release_part();
        }
    }

    /// Computes the effect of `command`, and starts its motion if it moves the machine. Returns the duration in s and
    /// the data lines that the server sends.
    ///
    /// # Errors
    /// Returns the error with which the machine refuses the command, for example 508 before homing and 501 for an
    /// unsupported command.
    pub(super) fn carry_out(&mut self, command: &Command) -> Result<CommandResult, DmeError> {
        let no = |number| DmeError::new(number, &command.name);
        self.joystick &= !moves(&command.name);
        self.current_command.clone_from(&command.name);
        match (command.name.as_str(), &command.arguments[..]) {
            ("Home", []) => {
                let [least, most] = self.probe.volume_mm();
                let corner = [least[0], most[1], most[2]];
                self.homed = true;
                Ok(self.start_motion(corner))
            }
            ("GoTo" | "PtMeas" | "ScanOnCurve" | "ChangeTool", _) if !self.homed => Err(no(508)),
            ("ChangeTool", [Argument::Text(name)]) => {
                let known = self.options.tools.iter().any(|(tool, _)| tool == name);
                if !known {
                    return Err(no(1502));
                }
                self.tool.clone_from(name);
                self.start_motion(self.at_mm);
                Ok(CommandResult { seconds: 10.0, ..CommandResult::default() })
            }
            ("GoTo", axes) => {
                let to = self.place(axes).ok_or_else(|| no(502))?;
                self.check_volume(to).map_err(no)?;
                Ok(self.start_motion(to))
            }
            ("PtMeas", axes) => self.touch(axes).map_err(no),
            ("ScanOnCurve", [closed, format, data]) => self.scan(closed, format, data).map_err(no),
            _ => self.apply_setting(command),
        }
    }

    /// Computes the effect of a command that selects a setting. Passes any other command to [`Self::answer_query`].
    fn apply_setting(&mut self, command: &Command) -> Result<CommandResult, DmeError> {
        let no = |number| DmeError::new(number, &command.name);
        match (command.name.as_str(), &command.arguments[..]) {
            ("EnableUser" | "DisableUser", []) => {
                self.joystick = command.name == "EnableUser";
                Ok(CommandResult::default())
            }
            ("SetCoordSystem", [Argument::Name(name, None)]) => {
                self.in_part_frame = match name.as_str() {
                    "PartCsy" => true,
                    "MachineCsy" => false,
                    _ => return Err(no(509)),
                };
                Ok(CommandResult::default())
            }
            ("SetCsyTransformation", [Argument::Name(name, None), rest @ ..]) if name == "PartCsy" => {
                let numbers: Vec<f64> =
                    rest.iter().filter_map(|a| if let Argument::Number(n) = a { Some(*n) } else { None }).collect();
                let written: [f64; 6] = numbers.try_into().map_err(|_| no(502))?;
                if !(0.0..=180.0).contains(&written[3]) {
                    return Err(no(1007));
                }
                self.part_frame = (written, frame(written));
                Ok(CommandResult::default())
            }
            ("SetProp", properties) => self.set(properties, &command.name).map_err(no),
            ("OnPtMeasReport", fields) => {
                self.report = query_names(fields, &["X", "Y", "Z", "IJK", "ER", "Q"]).ok_or_else(|| no(502))?;
                Ok(CommandResult::default())
            }
            ("OnScanReport", fields) => {
                self.scan_report = query_names(fields, &["X", "Y", "Z", "Q"]).ok_or_else(|| no(502))?;
                Ok(CommandResult::default())
            }
            ("ScanOnCurveHint", [Argument::Number(_), Argument::Number(_)]) => Ok(CommandResult::default()),
            ("ScanOnCurveDensity", fields) => {
                let nominals = Argument::Name("AtNominals".into(), Some(vec![1.0]));
                self.at_nominals = fields.contains(&nominals);
                Ok(CommandResult::default())
            }
            _ => self.answer_query(command),
        }
    }

    /// Returns the answer to a query. Refuses any other command with the error 501.
    fn answer_query(&self, command: &Command) -> Result<CommandResult, DmeError> {
        let no = |number| DmeError::new(number, &command.name);
        let text = |text: String| Ok(CommandResult::with_data(vec![text]));
        match (command.name.as_str(), &command.arguments[..]) {
            ("GetDMEVersion", []) => text(format!("DMEVersion(\"{}\")", self.options.version)),
            ("GetMachineClass", []) => text(format!("GetMachineClass(\"{}\")", self.options.class)),
            ("IsHomed" | "GetXtdErrStatus", []) => text(format!("IsHomed({})", u8::from(self.homed))),
            ("IsUserEnabled", []) => text(format!("IsUserEnabled({})", u8::from(self.joystick))),
            ("EnumTools", []) => {
                let data = self.options.tools.iter().map(|(name, _)| vec![format!("\"{name}\"")]).collect();
                Ok(CommandResult { data, ..CommandResult::default() })
            }
            ("GetCoordSystem", []) => {
                text(format!("CoordSystem({})", if self.in_part_frame { "PartCsy" } else { "MachineCsy" }))
            }
            ("GetCsyTransformation", [Argument::Name(name, None)]) if name == "PartCsy" => {
                let numbers = self.part_frame.0.map(|n| n.to_string()).join(", ");
                text(format!("GetCsyTransformation({numbers})"))
            }
            ("GetProp", properties) => self.get(properties).map_err(no),
            ("Get", fields) => {
                let at = self.frame().apply(self.at_mm);
                let told = fields.iter().map(|field| {
                    let name = query_name(field)?;
                    let k = ["X", "Y", "Z"].iter().position(|axis| *axis == name)?;
                    Some(format!("{name}({})", at[k]))
                });
                told.collect::<Option<_>>().map(CommandResult::with_data).ok_or_else(|| no(502))
            }
            _ => Err(no(501)),
        }
    }

    /// Returns the placement of the machine's frame in the selected frame.
    pub(super) fn frame(&self) -> Placement {
        if self.in_part_frame { self.part_frame.1 } else { Placement::IDENTITY }
    }

    /// Returns the position that the arguments X, Y and Z of a command describe, in mm. The arguments are in the
    /// selected frame. The returned position is in the machine's frame. A missing axis keeps its present value. The
    /// argument IJK is ignored. Returns `None` if `axes` contains any other argument.
    fn place(&self, axes: &[Argument]) -> Option<Vec3> {
        let mut at = self.frame().apply(self.at_mm);
        for axis in axes {
            let Argument::Name(name, Some(numbers)) = axis else { return None };
            match (name.as_str(), &numbers[..]) {
                ("X", [x]) => at[0] = *x,
                ("Y", [y]) => at[1] = *y,
                ("Z", [z]) => at[2] = *z,
                ("IJK", [_, _, _]) => {}
                _ => return None,
            }
        }
        Some(self.frame().apply_inverse(at))
    }

    pub(super) fn check_volume(&self, at: Vec3) -> Result<(), u16> {
        let [least, most] = self.probe.volume_mm();
        let within = (0..3).all(|k| (least[k] - 1e-9..=most[k] + 1e-9).contains(&at[k]));
        if within { Ok(()) } else { Err(1008) }
    }

    pub(super) fn start_motion(&mut self, to_mm: Vec3) -> CommandResult {
        self.to_mm = to_mm;
        self.events.push(MachineEvent::MotionStarted {
            command: self.current_command.clone(),
            from_mm: self.at_mm,
            to_mm,
        });
        let speed = self.parameters[0].min(self.probe.travel_mm_s());
        CommandResult { seconds: distance(self.at_mm, to_mm) / speed, ..CommandResult::default() }
    }

    /// Touches the simulated part or the reference sphere. `axes` are the arguments of PtMeas: the target X, Y, Z in mm
    /// and the outward normal IJK, in the selected frame. Returns the duration and the measured point as data fields.
    ///
    /// # Errors
    /// Returns an error number of the I++ DME standard:
    ///
    /// - 502 if the normal is missing or an argument is invalid
    /// - 508 if the tool has no radius
    /// - 1001 if the ball touches before the search begins
    /// - 1006 if no surface is found
    /// - 1008 if the path is outside the travel
    /// - 1010 if the normal has the length 0
    fn touch(&mut self, axes: &[Argument]) -> Result<CommandResult, u16> {
        let point_mm = self.place(axes).ok_or(502u16)?;
        let direction = axes.iter().find_map(|axis| match axis {
            Argument::Name(name, Some(numbers)) if name == "IJK" => <Vec3>::try_from(numbers.clone()).ok(),
            _ => None,
        });
        let direction = self.frame().turned_back(direction.ok_or(502u16)?);
        let norm = length(direction);
        if norm == 0.0 {
            return Err(1010);
        }
        let normal = direction.map(|c| c / norm);
        let radius_mm = self.radius().ok_or(508u16)?;
        let [_, _, approach_mm, search_mm, retract_mm, ..] = self.parameters;
        let on_way = |mm: f64| -> Vec3 { std::array::from_fn(|k| point_mm[k] + mm * normal[k]) };
        self.check_volume(on_way(approach_mm + radius_mm))?;
        self.check_volume(on_way(radius_mm - search_mm))?;
        let moved = self.start_motion(on_way(approach_mm + radius_mm)).seconds;
        self.contacts += 1;
        self.touched_mm = Some(point_mm[2]);
        let seconds = moved + self.probe.seconds_per_point();
        match self.probe.touch(point_mm, normal, [radius_mm, approach_mm, search_mm]) {
            TouchResult::Centre(centre) => {
                let back = if retract_mm < 0.0 {
                    on_way(approach_mm + radius_mm)
                } else {
                    std::array::from_fn(|k| centre[k] + retract_mm * normal[k])
                };
                self.to_mm = back;
                let fields = self.reported(centre, normal, radius_mm);
                let touched = Some(MachineEvent::Touched { point_mm, normal, centre_mm: centre });
                Ok(CommandResult { seconds, touched, ..CommandResult::with_data(fields) })
            }
            TouchResult::Missed => {
                self.arrive();
                Err(1006)
            }
            TouchResult::Unexpected => {
                self.arrive();
                Err(1001)
            }
        }
    }

    fn reported(&self, centre: Vec3, normal: Vec3, radius_mm: f64) -> Vec<String> {
        let frame = self.frame();
        let (at, inward) = (frame.apply(centre), frame.turned(normal));
        let field = |name: &String| match name.as_str() {
            "X" => format!("X({})", at[0]),
            "Y" => format!("Y({})", at[1]),
            "Z" => format!("Z({})", at[2]),
            "IJK" => format!("IJK({},{},{})", inward[0], inward[1], inward[2]),
            "ER" => format!("ER({radius_mm})"),
            _ => "Q(0)".to_owned(),
        };
        self.report.iter().map(field).collect()
    }

    pub(super) fn radius(&self) -> Option<f64> {
        let tool = self.options.tools.iter().find(|(name, _)| *name == self.tool);
        tool.map(|(_, radius)| *radius).filter(|radius| *radius > 0.0)
    }

    fn get(&self, properties: &[Argument]) -> Result<CommandResult, u16> {
        let told = properties.iter().map(|property| {
            let name = query_name(property).ok_or(502u16)?;
            match name.as_str() {
                "Tool.Name" => Ok(format!("Tool.Name(\"{}\")", self.tool)),
                "Tool.AvrRadius" if !self.reports_radius => Err(510),
                "Tool.AvrRadius" => self.radius().map(|radius| format!("Tool.AvrRadius({radius})")).ok_or(510),
                other => {
                    let k = PARAMETERS.iter().position(|known| other.strip_prefix("Tool.") == Some(*known));
                    k.map(|k| format!("{other}({})", self.parameters[k])).ok_or(510)
                }
            }
        });
        told.collect::<Result<_, _>>().map(CommandResult::with_data)
    }

    /// Sets parameters of the tool, such as speeds and search distances. Each item of `properties` is the name of a
    /// parameter with its new value. A value outside its limits is replaced by the nearest limit. In this case, the
    /// result contains a warning (error 504) with the text `cause`, which is the name of the command.
    ///
    /// # Errors
    /// Returns 502 for an argument that is not a property with one number, and 510 for an unknown property.
    fn set(&mut self, properties: &[Argument], cause: &str) -> Result<CommandResult, u16> {
        let mut warnings = Vec::new();
        for property in properties {
            let Argument::Name(name, Some(numbers)) = property else { return Err(502) };
            let k = PARAMETERS.iter().position(|known| name.strip_prefix("Tool.") == Some(*known)).ok_or(510u16)?;
            let [value] = numbers[..] else { return Err(502) };
            let most = self.options.max_speeds_mm_s.get(k).copied().unwrap_or(100.0);
            let least = if k == 4 || k == 6 { -1.0 } else { 1e-3 };
            let kept = value.clamp(least, most);
            if kept != value {
                warnings.push(DmeError::new(504, cause));
            }
            self.parameters[k] = kept;
        }
        Ok(CommandResult { warnings, ..CommandResult::default() })
    }
}

/// Returns the name of the property that an argument requests, for example `X` for `X()`. Returns `None` if the
/// argument has a value or is not a property.
fn query_name(argument: &Argument) -> Option<String> {
    match argument {
        Argument::Name(name, Some(numbers)) if numbers.is_empty() => Some(name.clone()),
        _ => None,
    }
}

/// Returns the names of the properties that arguments request. Returns `None` if one of them is not in `known`.
fn query_names(arguments: &[Argument], known: &[&str]) -> Option<Vec<String>> {
    let known = |name: &String| known.contains(&name.as_str());
    arguments.iter().map(|argument| query_name(argument).filter(known)).collect()
}
