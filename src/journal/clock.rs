//! Time of day in the format of records and file names.

use std::time::SystemTime;

/// Formats a time as UTC (RFC 3339), always with nine digits after the decimal point, so that the texts sort in the
/// order of their times.
///
/// A time before 1970, which a clock that was never set can show, is replaced by the beginning of 1970.
pub fn utc(at: SystemTime) -> String {
    humantime::format_rfc3339_nanos(at.max(SystemTime::UNIX_EPOCH)).to_string()
}

/// Formats a time as UTC (RFC 3339) without fractions of a second. A time before 1970 is replaced by the beginning of
/// 1970.
pub fn utc_to_the_second(at: SystemTime) -> String {
    humantime::format_rfc3339_seconds(at.max(SystemTime::UNIX_EPOCH)).to_string()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn utc_has_nanoseconds() {
        let at = SystemTime::UNIX_EPOCH + Duration::new(1_783_166_400, 120_000_000);
        assert_eq!(utc(at), "2026-07-04T12:00:00.120000000Z");
        assert_eq!(utc_to_the_second(at), "2026-07-04T12:00:00Z");
        // The step of the clock: Windows counts in units of 100 ns.
        let step = Duration::from_nanos(if cfg!(windows) { 100 } else { 1 });
        assert!(utc(at) < utc(at + step));
    }

    #[test]
    fn utc_before_epoch_is_epoch() {
        assert_eq!(utc(SystemTime::UNIX_EPOCH - Duration::from_secs(1)), "1970-01-01T00:00:00.000000000Z");
    }
}
