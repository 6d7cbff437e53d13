//! Payloads of docs/modbus.md, with an independent reader and writer: an error must not be the same at both ends of the
//! wire.
//!
//! The machines receive plan, map and pass, and send points and pass record, as bytes with the high word first.
//!
//! Received bytes are not trusted: format, length, count, reserved zeros, finite numbers and declared extremes are
//! checked before memory of that size is allocated. A fault gives a [`Refusal`] in words.

use crate::Vec3;
use crate::body::Refusal;
use crate::vector::length;

/// Maximum number of targets in a plan.
pub const MAX_TARGETS: u32 = 500_000;
/// Maximum number of columns, and of rows, in a map.
pub const MAX_NODES_PER_SIDE: u32 = 4_000;
/// Maximum number of nodes in a map.
pub const MAX_NODES: u64 = 4_000_000;

/// Answer of docs/modbus.md: a payload is missing, broken or of another part.
pub const BROKEN: u16 = 8;
/// Answer of docs/modbus.md: an interlock is open.
pub const INTERLOCK: u16 = 9;
/// Answer of docs/modbus.md: a value is outside the machine's limits.
pub const OUTSIDE: u16 = 10;

/// Feature that a target is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Feature {
    /// The ground part.
    Part = 1,
    /// The reference sphere on the table.
    ReferenceSphere = 2,
}

/// Point to touch, in the frame of the measuring machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Number of the target in the client.
    pub index: u32,
    /// Feature that the target is on.
    pub feature: Feature,
    /// The nominal contact point in millimetres.
    pub point_mm: Vec3,
    /// The outward unit normal there.
    pub normal: Vec3,
}

/// Kind 1: targets of the measuring machine, and how to touch them.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// Stated radius of the probe, in mm.
    pub probe_radius_mm: f64,
    /// Distance of the ball's surface from the target where the search begins, in millimetres.
    pub approach_mm: f64,
    /// Distance beyond the target at which the search ends, in mm.
    pub search_mm: f64,
    /// Speed of the search in millimetres per second.
    pub speed_mm_s: f64,
    /// Height over the highest target at which the probe travels, in millimetres.
    pub safe_height_mm: f64,
    /// Number of first targets that are touched slowly, and their speed in mm/s; 0 for none.
    pub careful: (u32, f64),
    /// The targets in the order in which they are touched.
    pub targets: Vec<Target>,
}

/// Kind 2: commanded displacement of the ground surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Nodes along x.
    pub columns: u32,
    /// Nodes along y.
    pub rows: u32,
    /// Position of the first node in the model frame, in mm.
    pub first_mm: [f64; 2],
    /// Spacing of the nodes along x and y, in mm.
    pub spacing_mm: [f64; 2],
    /// Identity of the nominal surface for which the map was made.
    pub nominal: [u8; 32],
    /// The displacements in millimetres, row by row, x fastest.
    pub values_mm: Vec<f64>,
}

/// Kind 3: motion of the grinder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pass {
    /// Repetitions of the finishing stroke without in-feed.
    pub spark_out: u16,
    /// Stated radius of the wheel, in mm.
    pub wheel_radius_mm: f64,
    /// Feed along the tracks in millimetres per minute.
    pub feed_mm_min: f64,
    /// Spacing of the tracks, in mm.
    pub track_spacing_mm: f64,
    /// Height of the commanded surface over the nominal, in mm.
    pub level_mm: f64,
    /// Maximum depth that one stroke may remove anywhere, in mm.
    pub depth_of_cut_mm: f64,
    /// Extent of the part in the model frame, in mm: x min, x max, y min, y max.
    pub extent_mm: [f64; 4],
    /// Identity of the nominal surface.
    pub nominal: [u8; 32],
}

/// Result of a target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// The ball touched.
    Touched = 1,
    /// The search ended without a touch.
    NotFound = 2,
    /// The probe did not reach the position at which the search begins.
    NotReached = 3,
}

/// One record of kind 4.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointRecord {
    /// Number of the target.
    pub index: u32,
    /// Result of the target.
    pub status: Status,
    /// Quality, from 0 (good) to 100 (bad).
    pub quality: u16,
    /// Centre of the ball, in mm; zeros if nothing was touched.
    pub position_mm: Vec3,
}

/// Kind 5: result of a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PassRecord {
    /// Run of the part.
    pub job: u32,
    /// Cycle of the run.
    pub cycle: u16,
    /// Result: 1 complete, 2 stopped, 3 aborted, 4 failed.
    pub result: u16,
    /// Path travelled in millimetres.
    pub path_mm: f64,
    /// Volume removed in cubic millimetres.
    pub volume_mm3: f64,
    /// Largest depth taken off in millimetres.
    pub depth_mm: f64,
    /// Fraction of the path on which the wheel cut air, from 0 to 1.
    pub air_share: f64,
    /// Spindle load; 1 is full load.
    pub spindle_load: f64,
    /// Radius of the wheel that the machine assumes, in mm.
    pub wheel_radius_mm: f64,
}

fn broken(reason: impl Into<String>) -> Refusal {
    Refusal { answer: BROKEN, reason: reason.into() }
}

pub(crate) fn outside(name: &str, value: f64, limits: &str) -> Refusal {
    Refusal { answer: OUTSIDE, reason: format!("{name} is {value}, allowed is {limits}") }
}

/// Reads big-endian values one after the other.
struct Reader<'a> {
    rest: &'a [u8],
}

impl Reader<'_> {
    fn read_bytes<const N: usize>(&mut self) -> Result<[u8; N], Refusal> {
        let (head, rest) = self.rest.split_first_chunk::<N>().ok_or_else(|| broken("the payload ends too early"))?;
        self.rest = rest;
        Ok(*head)
    }

    fn u16(&mut self) -> Result<u16, Refusal> {
        self.read_bytes().map(u16::from_be_bytes)
    }

    fn u32(&mut self) -> Result<u32, Refusal> {
        self.read_bytes().map(u32::from_be_bytes)
    }

    fn f64(&mut self, name: &str) -> Result<f64, Refusal> {
        let value = f64::from_be_bytes(self.read_bytes()?);
        if value.is_finite() { Ok(value) } else { Err(broken(format!("{name} is not finite"))) }
    }

    fn vector<const N: usize>(&mut self, name: &str) -> Result<[f64; N], Refusal> {
        let mut vector = [0.0; N];
        for value in &mut vector {
            *value = self.f64(name)?;
        }
        Ok(vector)
    }

    fn format(&mut self) -> Result<(), Refusal> {
        match self.u16()? {
            1 => Ok(()),
            other => Err(broken(format!("format is {other}, known is 1"))),
        }
    }

    fn zeros<const N: usize>(&mut self, name: &str) -> Result<(), Refusal> {
        if self.read_bytes::<N>()? == [0; N] {
            Ok(())
        } else {
            Err(broken(format!("reserved bytes after {name} are not 0")))
        }
    }
}

/// Checks that the length of `bytes` is `header` + `records` × `size`: a header, then records of `size` bytes each.
///
/// # Errors
/// Returns a refusal if the length is different.
fn exact(bytes: &[u8], header: u64, records: u64, size: u64) -> Result<(), Refusal> {
    let expected = header + records * size;
    if bytes.len() as u64 == expected {
        return Ok(());
    }
    Err(broken(format!("{} bytes, where {records} records make {expected}", bytes.len())))
}

fn within(name: &str, value: f64, least: f64, most: f64) -> Result<(), Refusal> {
    if (least..=most).contains(&value) { Ok(()) } else { Err(outside(name, value, &format!("{least} to {most}"))) }
}

impl Target {
    fn decode(reader: &mut Reader) -> Result<Self, Refusal> {
        let index = reader.u32()?;
        let feature = match reader.u16()? {
            1 => Feature::Part,
            2 => Feature::ReferenceSphere,
            other => {
                return Err(broken(format!("target {index} is on {other}; 1 is the part, 2 the reference sphere")));
            }
        };
        reader.zeros::<2>("what")?;
        let (point_mm, normal) = (reader.vector("point of a target")?, reader.vector::<3>("normal of a target")?);
        let length = length(normal);
        // Written so that an overflow to infinity is refused too.
        if (length - 1.0).abs() <= 1e-6 {
            let normal = normal.map(|c| c / length);
            return Ok(Self { index, feature, point_mm, normal });
        }
        Err(broken(format!("normal of target {index} has the length {length}")))
    }
}

impl Plan {
    /// Decodes a measuring plan.
    ///
    /// # Errors
    /// The bytes are not a plan, or a value is not possible for a probe.
    pub fn decode(bytes: &[u8]) -> Result<Self, Refusal> {
        let mut reader = Reader { rest: bytes };
        reader.format()?;
        reader.zeros::<2>("format")?;
        let count = reader.u32()?;
        exact(bytes, 64, count.into(), 56)?;
        if !(1..=MAX_TARGETS).contains(&count) {
            return Err(outside("number of targets", count.into(), &format!("1 to {MAX_TARGETS}")));
        }
        let [probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm] =
            reader.vector("header of the plan")?;
        let careful = reader.u32()?;
        reader.zeros::<4>("number of careful targets")?;
        let [careful_mm_s] = reader.vector("header of the plan")?;
        within("probe radius in mm", probe_radius_mm, 0.01, 100.0)?;
        within("approach in mm", approach_mm, 0.0, 100.0)?;
        within("search in mm", search_mm, 0.0, 100.0)?;
        within("speed in mm/s", speed_mm_s, 1e-3, 1000.0)?;
        within("safe height in mm", safe_height_mm, 0.0, 1000.0)?;
        within("number of careful targets", careful.into(), 0.0, count.into())?;
        let slowest = if careful == 0 { 0.0 } else { 1e-4 };
        within("careful speed in mm/s", careful_mm_s, slowest, if careful == 0 { 0.0 } else { speed_mm_s })?;
        let careful = (careful, careful_mm_s);
        let targets = (0..count).map(|_| Target::decode(&mut reader)).collect::<Result<_, _>>()?;
        Ok(Self { probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm, careful, targets })
    }
}

impl Map {
    /// Decodes a correction map from the bytes of a payload of kind 2 in docs/modbus.md.
    ///
    /// # Errors
    /// Returns a refusal if the bytes are not a map, or if the map has too many nodes. Also returns a refusal if the
    /// largest absolute value in the header differs from the largest absolute value of the nodes.
    pub fn decode(bytes: &[u8]) -> Result<Self, Refusal> {
        let mut reader = Reader { rest: bytes };
        reader.format()?;
        match reader.u16()? {
            1 => {}
            other => return Err(broken(format!("sign is {other}, known is 1"))),
        }
        let (columns, rows) = (reader.u32()?, reader.u32()?);
        reader.zeros::<4>("rows")?;
        let nodes = u64::from(columns) * u64::from(rows);
        if columns > MAX_NODES_PER_SIDE || rows > MAX_NODES_PER_SIDE || nodes > MAX_NODES {
            return Err(outside("number of nodes", nodes as f64, &format!("up to {MAX_NODES}")));
        }
        if columns < 2 || rows < 2 {
            return Err(broken(format!("a grid of {columns} by {rows} nodes spans no area")));
        }
        exact(bytes, 96, nodes, 8)?;
        let first_mm = reader.vector("place of the first node")?;
        let spacing_mm = reader.vector::<2>("spacing")?;
        let max_mm = reader.f64("largest value")?;
        reader.zeros::<8>("largest value")?;
        let nominal = reader.read_bytes()?;
        if !spacing_mm.iter().all(|s| (1e-6..=1e6).contains(s)) {
            return Err(broken(format!("spacing is {spacing_mm:?} mm")));
        }
        let values_mm = (0..nodes).map(|_| reader.f64("a node of the map")).collect::<Result<Vec<_>, _>>()?;
        let map = Self { columns, rows, first_mm, spacing_mm, nominal, values_mm };
        if (map.max_abs_mm() - max_mm).abs() > 1e-9 {
            return Err(broken(format!("largest value is {} mm, the header says {max_mm}", map.max_abs_mm())));
        }
        Ok(map)
    }

    /// Returns the largest absolute value of all nodes, in mm.
    pub fn max_abs_mm(&self) -> f64 {
        self.values_mm.iter().fold(0.0, |most, value| value.abs().max(most))
    }

    /// Returns the displacement at (x, y) in mm: bilinear inside the grid; outside, the value at the nearest edge.
    pub fn displacement_at(&self, x: f64, y: f64) -> f64 {
        let along = |t: f64, axis: usize, nodes: u32| {
            let place = ((t - self.first_mm[axis]) / self.spacing_mm[axis]).clamp(0.0, f64::from(nodes - 1));
            let cell = (place as usize).min(nodes as usize - 2);
            (cell, place - cell as f64)
        };
        let ((i, u), (j, v)) = (along(x, 0, self.columns), along(y, 1, self.rows));
        let node = |i: usize, j: usize| self.values_mm[j * self.columns as usize + i];
        let row = |j: usize| node(i, j) + u * (node(i + 1, j) - node(i, j));
        row(j) + v * (row(j + 1) - row(j))
    }
}

impl Pass {
    /// Decodes the settings of a pass.
    ///
    /// # Errors
    /// The bytes are not such settings, or a value is not possible for a grinder.
    pub fn decode(bytes: &[u8]) -> Result<Self, Refusal> {
        exact(bytes, 128, 0, 0)?;
        let mut reader = Reader { rest: bytes };
        reader.format()?;
        let spark_out = reader.u16()?;
        reader.zeros::<4>("spark-out passes")?;
        let [wheel_radius_mm, feed_mm_min, track_spacing_mm, level_mm, depth_of_cut_mm] =
            reader.vector("header of the pass")?;
        let extent_mm = reader.vector::<4>("extent of the part")?;
        reader.zeros::<16>("extent")?;
        let nominal = reader.read_bytes()?;
        within("spark-out passes", spark_out.into(), 0.0, 20.0)?;
        within("wheel radius in mm", wheel_radius_mm, 0.5, 1000.0)?;
        within("feed in mm/min", feed_mm_min, 1.0, 50_000.0)?;
        within("track spacing in mm", track_spacing_mm, 0.01, 50.0)?;
        within("level in mm", level_mm, -10.0, 10.0)?;
        within("depth of cut in mm", depth_of_cut_mm, 1e-5, 10.0)?;
        let [x0, x1, y0, y1] = extent_mm;
        if x0 < x1 && y0 < y1 {
            let pass = Self {
                spark_out,
                wheel_radius_mm,
                feed_mm_min,
                track_spacing_mm,
                level_mm,
                depth_of_cut_mm,
                extent_mm,
                nominal,
            };
            return Ok(pass);
        }
        Err(broken(format!("the part's extent is x {x0} to {x1}, y {y0} to {y1} mm")))
    }
}

/// Returns the measured points as bytes, high word first (kind 4 in docs/modbus.md). If `scale_mm` is `None`, a
/// coordinate is a 64-bit float in mm (format 1). Otherwise a coordinate is a whole number of steps of `scale_mm`
/// (format 2).
pub fn encode_points(records: &[PointRecord], scale_mm: Option<f64>) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(32 * records.len());
    for record in records {
        bytes.extend(record.index.to_be_bytes());
        bytes.extend((record.status as u16).to_be_bytes());
        bytes.extend(record.quality.to_be_bytes());
        match scale_mm {
            None => push(&mut bytes, &record.position_mm),
            // A cast to an integer saturates, and turns NaN into 0; the travel of the machine is far within the range.
            Some(scale) => {
                bytes.extend(record.position_mm.iter().flat_map(|c| ((c / scale).round() as i32).to_be_bytes()));
            }
        }
    }
    bytes
}

impl PassRecord {
    /// Returns the pass record (the result of a grinding pass) as bytes, high word first: one record of kind 5 in
    /// docs/modbus.md.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(64);
        bytes.extend(self.job.to_be_bytes());
        bytes.extend(self.cycle.to_be_bytes());
        bytes.extend(self.result.to_be_bytes());
        let figures = [
            self.path_mm,
            self.volume_mm3,
            self.depth_mm,
            self.air_share,
            self.spindle_load,
            self.wheel_radius_mm,
            0.0,
        ];
        push(&mut bytes, &figures);
        bytes
    }
}

fn push(bytes: &mut Vec<u8>, values: &[f64]) {
    bytes.extend(values.iter().flat_map(|value| value.to_be_bytes()));
}
