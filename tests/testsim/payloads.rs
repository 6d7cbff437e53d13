//! Client's end of the payloads of docs/modbus.md, for tests that act as the client of a simulated machine.

use regrind_sim::payload::{Map, Pass, PassRecord, Plan, PointRecord, Status};

/// Payload that a client sends.
pub trait Encode {
    /// Returns the payload as bytes, high word first.
    fn encode(&self) -> Vec<u8>;
}

impl Encode for Plan {
    fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend((self.targets.len() as u32).to_be_bytes());
        let header = [self.probe_radius_mm, self.approach_mm, self.search_mm, self.speed_mm_s, self.safe_height_mm];
        push(&mut bytes, &header);
        bytes.extend(self.careful.0.to_be_bytes());
        bytes.extend([0; 4]);
        push(&mut bytes, &[self.careful.1]);
        for target in &self.targets {
            bytes.extend(target.index.to_be_bytes());
            bytes.extend((target.feature as u16).to_be_bytes());
            bytes.extend([0; 2]);
            push(&mut bytes, &target.point_mm);
            push(&mut bytes, &target.normal);
        }
        bytes
    }
}

impl Encode for Map {
    fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![0, 1, 0, 1];
        bytes.extend(self.columns.to_be_bytes());
        bytes.extend(self.rows.to_be_bytes());
        bytes.extend([0; 4]);
        push(&mut bytes, &self.first_mm);
        push(&mut bytes, &self.spacing_mm);
        push(&mut bytes, &[self.max_abs_mm()]);
        bytes.extend([0; 8]);
        bytes.extend(self.nominal);
        push(&mut bytes, &self.values_mm);
        bytes
    }
}

impl Encode for Pass {
    fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![0, 1];
        bytes.extend(self.spark_out.to_be_bytes());
        bytes.extend([0; 4]);
        let header =
            [self.wheel_radius_mm, self.feed_mm_min, self.track_spacing_mm, self.level_mm, self.depth_of_cut_mm];
        push(&mut bytes, &header);
        push(&mut bytes, &self.extent_mm);
        bytes.extend([0; 16]);
        bytes.extend(self.nominal);
        bytes
    }
}

fn push(bytes: &mut Vec<u8>, values: &[f64]) {
    bytes.extend(values.iter().flat_map(|value| value.to_be_bytes()));
}

/// Decodes measured points. `scale_mm` is the value with which the machine encoded them: `None` for coordinates in mm,
/// otherwise the step of whole numbers. Returns `None` if the bytes are not such points.
pub fn decode_points(bytes: &[u8], scale_mm: Option<f64>) -> Option<Vec<PointRecord>> {
    let records = bytes.chunks_exact(if scale_mm.is_some() { 20 } else { 32 });
    records.remainder().is_empty().then_some(())?;
    records.map(|record| point(record, scale_mm)).collect()
}

fn point(record: &[u8], scale_mm: Option<f64>) -> Option<PointRecord> {
    let (head, coordinates) = record.split_at(8);
    let status = match u16::from_be_bytes([head[4], head[5]]) {
        1 => Status::Touched,
        2 => Status::NotFound,
        3 => Status::NotReached,
        _ => return None,
    };
    let value = |bytes: &[u8]| match scale_mm {
        Some(scale) => Some(scale * f64::from(i32::from_be_bytes(bytes.try_into().ok()?))),
        None => Some(f64::from_be_bytes(bytes.try_into().ok()?)).filter(|value| value.is_finite()),
    };
    let position: Option<Vec<f64>> = coordinates.chunks(coordinates.len() / 3).map(value).collect();
    Some(PointRecord {
        index: u32::from_be_bytes(head[..4].try_into().ok()?),
        status,
        quality: u16::from_be_bytes([head[6], head[7]]),
        position_mm: position?.try_into().ok()?,
    })
}

/// Decodes a pass record. Returns `None` if the bytes are not one.
pub fn decode_pass_record(bytes: &[u8]) -> Option<PassRecord> {
    let (head, figures) = bytes.split_at_checked(8)?;
    let figures: Option<Vec<f64>> = figures.chunks(8).map(|f| Some(f64::from_be_bytes(f.try_into().ok()?))).collect();
    let [path_mm, volume_mm3, depth_mm, air_share, spindle_load, wheel_radius_mm, _] = figures?[..] else {
        return None;
    };
    let job = u32::from_be_bytes(head[..4].try_into().ok()?);
    let [cycle, result] = [4, 6].map(|at| u16::from_be_bytes([head[at], head[at + 1]]));
    Some(PassRecord { job, cycle, result, path_mm, volume_mm3, depth_mm, air_share, spindle_load, wheel_radius_mm })
}
