//! Header of a result: its identity, its size, and what its records mean. A driver reads it before the records.

/// Maximum size of a result of a measuring machine, in bytes.
pub(super) const MAX_RESULT_BYTES: u32 = 64 << 20;

/// Header of a result.
#[derive(Debug, Clone)]
pub(super) struct Header {
    pub(super) format: u16,
    pub(super) bytes: u32,
    pub(super) crc: u32,
    pub(super) records: u32,
    pub(super) registers: usize,
    pub(super) coordinates: u16,
    pub(super) probe_radius_mm: f64,
    pub(super) scale_mm: f64,
    /// Temperature in °C; `None` if the machine has no thermometer.
    pub(super) temperature_c: Option<f64>,
    pub(super) duration_s: f64,
    pub(super) identity: [u8; 32],
}
