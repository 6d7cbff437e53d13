//! Time of day in the format of records and file names.

use std::time::{Duration, SystemTime};

/// Time from 1970 to the last time that RFC 3339 can write, the end of the year 9999.
const LAST: Duration = Duration::new(253_402_300_799, 999_999_999);

/// Formats a time as UTC (RFC 3339), always with nine digits after the decimal point, so that the texts sort in the
/// order of their times.
///
/// A time before 1970, which a clock that was never set can show, is replaced by the beginning of 1970. A time after the
/// year 9999 is replaced by the end of that year.
pub fn utc(at: SystemTime) -> String {
    humantime::format_rfc3339_nanos(within_limits(at)).to_string()
}

/// Formats a time as UTC (RFC 3339) without fractions of a second. A time before 1970 is replaced by the beginning of
/// 1970, and a time after the year 9999 by the end of that year.
pub fn utc_to_the_second(at: SystemTime) -> String {
    humantime::format_rfc3339_seconds(within_limits(at)).to_string()
}

fn within_limits(at: SystemTime) -> SystemTime {
    at.clamp(SystemTime::UNIX_EPOCH, SystemTime::UNIX_EPOCH + LAST)
}

#[cfg(test)]
mod tests {
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
    fn utc_after_last_year_is_its_end() {
        for more in [0, 1, 1 << 34] {
            let at = SystemTime::UNIX_EPOCH + LAST + Duration::from_secs(more);
            // Windows counts in units of 100 ns.
            assert!(utc(at).starts_with("9999-12-31T23:59:59.9999999"), "{}", utc(at));
            assert_eq!(utc_to_the_second(at), "9999-12-31T23:59:59Z");
        }
    }

    #[test]
    fn utc_before_epoch_is_epoch() {
        assert_eq!(utc(SystemTime::UNIX_EPOCH - Duration::from_secs(1)), "1970-01-01T00:00:00.000000000Z");
    }
}
